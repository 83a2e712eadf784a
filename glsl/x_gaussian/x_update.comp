#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient of each Gaussian of X-Gaussian with respect to its stored numbers, from its sums in the tiles in which it is
// visible, in their order; the statistics of density control; and Adam's update. The kernel does nothing if the lists exceeded
// the capacity. One invocation per Gaussian.
#include "inc/blend.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
#include "inc/x_layout.glsl"
layout(push_constant) uniform Push { uint n_gaussians; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { BlendSetup blend_setup; };
layout(binding = 2) readonly buffer B2 { GaussianView gaussian_views[]; };
layout(binding = 3) readonly buffer B3 { uint blend_set_of[]; };
layout(binding = 4) readonly buffer B4 { PictureTurn picture_turns[]; };
layout(binding = 5) readonly buffer B5 { XSchedule x_schedule[]; };
layout(binding = 6) readonly buffer B6 { uint gaussian_step; };
layout(binding = 7) readonly buffer B7 { BlendSpan blend_spans[]; };
layout(binding = 8) readonly buffer B8 { BlendCounts blend_counts; };
// [entry][7 sums]
layout(binding = 9) readonly buffer B9 { float x_entries[]; };
layout(binding = 10) buffer B10 { BlendGaussian blend_gaussians[]; };
// First and second moments of Adam, in the layout of the Gaussians: position and opacity, scale and intensity, rotation.
layout(binding = 11) buffer B11 { vec4 gaussian_adam_first[]; };
layout(binding = 12) buffer B12 { vec4 gaussian_adam_second[]; };
// Gradient in this layout.
layout(binding = 13) writeonly buffer B13 { vec4 gaussian_gradient[]; };
layout(binding = 14) buffer B14 { XStatistics x_statistics[]; };

vec4 step_of(uint at, vec4 g, vec4 rate, XSchedule now) {
    gaussian_gradient[at] = g;
    if (now.updates == 0u) return vec4(0.0);
    float beta1 = gaussian_setup.beta1, beta2 = gaussian_setup.beta2;
    vec4 first = beta1 * gaussian_adam_first[at] + (1.0 - beta1) * g;
    vec4 second = beta2 * gaussian_adam_second[at] + (1.0 - beta2) * g * g;
    gaussian_adam_first[at] = first;
    gaussian_adam_second[at] = second;
    return rate * (first / now.bias1) / (sqrt(second / now.bias2) + gaussian_setup.epsilon);
}

void main() {
    uint i = invocation();
    if (i >= push.n_gaussians || blend_counts.entries > blend_setup.capacity) return;
    XSchedule now = x_schedule[gaussian_step];
    BlendGaussian g = blend_gaussians[i];
    BlendSpan span = blend_spans[i];
    uvec2 tiles = columns_and_rows(span);
    uint n = tiles.x * tiles.y;
    GaussianGradient sum = no_gradient();
    float by_intensity = 0.0;
    if (n > 0u) {
        vec3 linear = vec3(0.0), square = vec3(0.0);
        for (uint k = 7u * span.first_entry; k < 7u * (span.first_entry + n); k += 7u) {
            linear += vec3(x_entries[k], x_entries[k + 1u], x_entries[k + 2u]);
            square += vec3(x_entries[k + 3u], x_entries[k + 4u], x_entries[k + 5u]);
            by_intensity += x_entries[k + 6u];
        }
        GaussianView view = gaussian_views[picture_turns[gaussian_step * blend_setup.n_sets + blend_set_of[i]].image];
        BlendProjection p = project_blended(g, view, gaussian_setup, blend_setup);
        sum = gradient_x(g, p, view, linear, square);
        if (!(g.intensity > 0.0)) by_intensity = 0.0;
        vec2 half_image = 0.5 * vec2(float(gaussian_setup.width), float(gaussian_setup.height));
        vec3 conic = p.splat.conic;
        vec2 pull = half_image * vec2(dot(conic.xy, linear.yz), dot(conic.yz, linear.yz));
        x_statistics[i].pull += length(pull);
        x_statistics[i].seen += 1.0;
        x_statistics[i].radius = max(x_statistics[i].radius, p.splat.half_box.x);
    }
    vec4 place_rate = vec4(vec3(now.position_rate), now.opacity_rate);
    vec4 moved = step_of(3u * i, vec4(sum.position, sum.log_density), place_rate, now);
    vec4 scale_rate = vec4(vec3(now.scale_rate), now.intensity_rate);
    vec4 grown = step_of(3u * i + 1u, vec4(sum.log_scale, by_intensity), scale_rate, now);
    vec4 turned = step_of(3u * i + 2u, sum.rotation, vec4(now.rotation_rate), now);
    blend_gaussians[i].position = g.position - moved.xyz;
    blend_gaussians[i].opacity = g.opacity - moved.w;
    blend_gaussians[i].log_scale = g.log_scale - grown.xyz;
    blend_gaussians[i].intensity = g.intensity - grown.w;
    blend_gaussians[i].rotation = g.rotation - turned;
}
