#version 450
#extension GL_GOOGLE_include_directive : require
// Gradients of the output neuron's weights and bias, as partial sums per split. One workgroup per (4 weights, split).
//   partials[split][parameter]; later chunks of an iteration add to the values of the first chunk.
#include "inc/layout.glsl"
#include "inc/operands.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint weights; uint bias; uint capacity; uint splits; uint n_partials; uint accumulate; } push;
layout(binding = 0) readonly buffer B0 { LiveSamples live; };
layout(binding = 1) readonly buffer B1 { float sample_feature_gradient[]; };
READ_VEC4(2, B2, activations);
layout(binding = 3) buffer B3 { float partials[]; };
#include "inc/reduce.glsl"

void put(uint parameter, float value) {
    uint i = gl_WorkGroupID.y * push.n_partials + parameter;
    partials[i] = value + (push.accumulate != 0u ? partials[i] : 0.0);
}

void main() {
    uint q = gl_WorkGroupID.x;
    uint per = (live.padded + push.splits - 1u) / push.splits;
    uint begin = gl_WorkGroupID.y * per;
    uint end = min(begin + per, live.padded);
    vec4 sum = vec4(0.0);
    float bias = 0.0;
    for (uint s = begin + gl_LocalInvocationID.x; s < end; s += gl_WorkGroupSize.x) {
        float g = sample_feature_gradient[s];
        sum += g * FETCH(activations, q * push.capacity + s);
        bias += g;
    }
    for (uint c = 0u; c < 4u; c++) {
        float total = workgroup_sum(sum[c]);
        if (gl_LocalInvocationID.x == 0u) put(push.weights + 4u * q + c, total);
    }
    bias = workgroup_sum(bias);
    if (q == 0u && gl_LocalInvocationID.x == 0u) put(push.bias, bias);
}
