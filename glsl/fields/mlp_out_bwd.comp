#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient at the output neuron and at the last hidden layer. One invocation per padded sample.
//   sample_feature_gradient[s] = dL/df;  dz[q * capacity + s] = w_out * dL/df where the neuron is positive.
#include "inc/layout.glsl"
#include "inc/sample_rays.glsl"
#include "inc/operands.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint groups; uint weights4; uint capacity; } push;
layout(binding = 0) SETUP B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { LiveSamples live; };
layout(binding = 2) readonly buffer B2 { vec4 sample_points[]; };
layout(binding = 3) readonly buffer B3 { uint sample_rays[]; };
layout(binding = 4) readonly buffer B4 { vec2 sample_sigma[]; };
layout(binding = 5) readonly buffer B5 { vec2 ray_gradient[]; };
READ_VEC4(6, B6, activations);
READ_VEC4(7, B7, params);
layout(binding = 8) writeonly buffer B8 { float sample_feature_gradient[]; };
layout(binding = 9) writeonly buffer B9 { vec4 dz[]; };
layout(binding = 10) readonly buffer B10 { float sigma_gradient[]; };
#include "inc/sample_gradient.glsl"

void main() {
    uint s = gl_GlobalInvocationID.x;
    if (s >= live.padded) return;
    float gradient = s < live.count ? feature_gradient(s) : 0.0;
    sample_feature_gradient[s] = gradient;
    for (uint q = 0u; q < push.groups; q++) {
        vec4 on = vec4(greaterThan(FETCH(activations, q * push.capacity + s), vec4(0.0)));
        dz[q * push.capacity + s] = gradient * on * FETCH(params, push.weights4 + q);
    }
}
