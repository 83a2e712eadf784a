#version 450
#extension GL_GOOGLE_include_directive : require
// Output neuron and activation: sample_sigma[s] = (sigma_s, d sigma_s / d feature). One invocation per sample.
#include "inc/layout.glsl"
#include "inc/operands.glsl"
#include "inc/softplus.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint groups; uint weights4; uint bias; uint capacity; } push;
layout(binding = 0) SETUP B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { LiveSamples live; };
READ_VEC4(2, B2, activations);
READ_VEC4(3, B3, params);
layout(binding = 4) writeonly buffer B4 { vec2 sample_sigma[]; };

void main() {
    uint s = gl_GlobalInvocationID.x;
    if (s >= live.padded) return;
    float feature = FETCH(params, push.bias / 4u)[push.bias & 3u];
    for (uint q = 0u; q < push.groups; q++) {
        feature += dot(FETCH(params, push.weights4 + q), FETCH(activations, q * push.capacity + s));
    }
    float x = feature + setup.dynamic_shift;
    sample_sigma[s] = setup.dynamic_gain * vec2(softplus(x), sigmoid(x));
}
