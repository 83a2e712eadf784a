#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient of each Gaussian from its moments, summed over the views in their order, and Adam's update. One invocation per
// Gaussian.
#include "inc/gaussian.glsl"
#include "inc/gaussian_gradient.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_gaussians; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) readonly buffer B1 { GaussianView gaussian_views[]; };
layout(binding = 2) readonly buffer B2 { int image_of_view[]; };
layout(binding = 3) readonly buffer B3 { vec4 splat_moments[]; };
layout(binding = 4) readonly buffer B4 { GaussianSchedule gaussian_schedule[]; };
layout(binding = 5) readonly buffer B5 { uint gaussian_step; };
layout(binding = 6) buffer B6 { Gaussian gaussians[]; };
// First and second moments of Adam, in the layout of the Gaussians: position and log-density, log-scale, rotation.
layout(binding = 7) buffer B7 { vec4 gaussian_adam_first[]; };
layout(binding = 8) buffer B8 { vec4 gaussian_adam_second[]; };
// Gradient in this layout.
layout(binding = 9) writeonly buffer B9 { vec4 gaussian_gradient[]; };

#include "inc/gaussian_adam.glsl"

vec4 step_of(uint at, vec4 g, vec4 rate, GaussianSchedule now) {
    vec4 first = gaussian_adam_first[at], second = gaussian_adam_second[at];
    vec4 moved = adam(g, rate, now, first, second);
    gaussian_adam_first[at] = first;
    gaussian_adam_second[at] = second;
    gaussian_gradient[at] = g;
    return moved;
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= push.n_gaussians) return;
    GaussianSchedule now = gaussian_schedule[gaussian_step];
    Gaussian g = gaussians[i];
    GaussianGradient sum = no_gradient();
    for (uint view = 0u; view < gaussian_setup.n_views; view++) {
        int image = image_of_view[g.phase * gaussian_setup.n_views + view];
        if (image < 0) continue;
        Projection p = project(g, g.position, gaussian_views[image], gaussian_setup);
        if (!(p.depth > 0.0)) continue;
        uint at = 2u * (view * push.n_gaussians + i);
        vec3 linear = splat_moments[at].xyz, square = splat_moments[at + 1u].xyz;
        add_gradient(g, p, gaussian_views[image], gaussian_setup, linear, square, sum);
    }
    vec4 place_rate = vec4(vec3(gaussian_setup.position_rate), gaussian_setup.density_rate);
    vec4 place = step_of(3u * i, vec4(sum.position, sum.log_density), place_rate, now);
    vec4 scale = step_of(3u * i + 1u, vec4(sum.log_scale, 0.0), vec4(gaussian_setup.scale_rate), now);
    vec4 turn = step_of(3u * i + 2u, sum.rotation, vec4(gaussian_setup.rotation_rate), now);
    gaussians[i].position = g.position - place.xyz;
    gaussians[i].log_density = g.log_density - place.w;
    gaussians[i].log_scale = g.log_scale - scale.xyz;
    gaussians[i].rotation = g.rotation - turn;
}
