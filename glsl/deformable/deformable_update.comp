#version 450
#extension GL_GOOGLE_include_directive : require
// Adam's update of the deformable set's Gaussians and their own motion. One invocation per Gaussian.
#include "inc/gaussian.glsl"
#include "inc/deformable_grid.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_gaussians; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { MotionGridSetup deformable_setup; };
layout(binding = 2) readonly buffer B2 { GaussianSchedule gaussian_schedule[]; };
layout(binding = 3) readonly buffer B3 { uint gaussian_step; };
layout(binding = 4) readonly buffer B4 { vec4 gaussian_gradient[]; };
layout(binding = 5) readonly buffer B5 { vec4 place_gradient[]; };
layout(binding = 6) readonly buffer B6 { float motion_basis[]; };
layout(binding = 7) buffer B7 { Gaussian gaussians[]; };
layout(binding = 8) buffer B8 { vec4 gaussian_adam_first[]; };
layout(binding = 9) buffer B9 { vec4 gaussian_adam_second[]; };
layout(binding = 10) buffer B10 { vec4 own_motion[]; };
layout(binding = 11) buffer B11 { vec4 own_motion_first[]; };
layout(binding = 12) buffer B12 { vec4 own_motion_second[]; };
#include "inc/gaussian_adam.glsl"

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= push.n_gaussians) return;
    GaussianSchedule now = gaussian_schedule[gaussian_step];
    vec4 place_rate = vec4(vec3(gaussian_setup.position_rate), gaussian_setup.density_rate);
    vec4 rates[3] = vec4[3](place_rate, vec4(gaussian_setup.scale_rate), vec4(gaussian_setup.rotation_rate));
    vec4 steps[3];
    for (uint k = 0u; k < 3u; k++) {
        vec4 first = gaussian_adam_first[3u * i + k], second = gaussian_adam_second[3u * i + k];
        steps[k] = adam(gaussian_gradient[3u * i + k], rates[k], now, first, second);
        gaussian_adam_first[3u * i + k] = first;
        gaussian_adam_second[3u * i + k] = second;
    }
    gaussians[i].position -= steps[0].xyz;
    gaussians[i].log_density -= steps[0].w;
    gaussians[i].log_scale -= steps[1].xyz;
    gaussians[i].rotation -= steps[2];
    for (uint k = 0u; k < deformable_setup.n_basis; k++) {
        uint at = i * deformable_setup.n_basis + k;
        vec4 g = 2.0 * deformable_setup.own_penalty * own_motion[at];
        for (uint phase = 0u; phase < gaussian_setup.n_phases; phase++)
            g += motion_basis[phase * deformable_setup.n_basis + k] * place_gradient[phase * push.n_gaussians + i];
        vec4 first = own_motion_first[at], second = own_motion_second[at];
        own_motion[at] -= adam(g, vec4(deformable_setup.own_rate), now, first, second);
        own_motion_first[at] = first;
        own_motion_second[at] = second;
    }
}
