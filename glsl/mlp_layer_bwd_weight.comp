#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Weight gradient dW[j][k] = sum_s dz[j][s] x[k][s], partial sums per split. One workgroup per
// (8 neurons, 8 inputs, split): lanes stride over samples, each with an 8 x 8 register tile, then a
// fixed-order sum over lanes through shared memory.
// The workgroups of the first inputs sum dz itself as well: the gradient of a bias.
//   partials[split][parameter]; later chunks of an iteration add to what the first wrote.
#include "inc/layout.glsl"
#include "inc/texels.glsl"
layout(local_size_x = 16, local_size_x_id = 0) in;
layout(push_constant) uniform Push {
    uint in_groups; uint weights; uint capacity; uint splits; uint n_partials; uint accumulate;
    uint bias;  // also sum dz into this parameter, unless it is ~0
} push;
READ_VEC4(0, B0, dz);
READ_VEC4(1, B1, inputs);
layout(binding = 2) readonly buffer B2 { uint live[]; };
layout(binding = 3) buffer B3 { float partials[]; };

shared float lanes_sum[64u * gl_WorkGroupSize.x];

void put(uint parameter, float total) {
    uint at = gl_WorkGroupID.z * push.n_partials + parameter;
    partials[at] = total + (push.accumulate != 0u ? partials[at] : 0.0);
}

float over_lanes(uint e) {
    float total = 0.0;
    for (uint l = 0u; l < gl_WorkGroupSize.x; l++) total += lanes_sum[e * gl_WorkGroupSize.x + l];
    return total;
}

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint j4 = gl_WorkGroupID.x * 2u;
    uint k4 = gl_WorkGroupID.y * 2u;
    bool second_inputs = k4 + 1u < push.in_groups;
    uint per = (live[1] + push.splits - 1u) / push.splits;
    uint begin = gl_WorkGroupID.z * per;
    uint end = min(begin + per, live[1]);
    vec4 sum[8][2];
    [[unroll]] for (uint j = 0u; j < 8u; j++) {
        sum[j][0] = vec4(0.0);
        sum[j][1] = vec4(0.0);
    }
    vec4 bias_sum[2] = vec4[2](vec4(0.0), vec4(0.0));
    uint k4b = second_inputs ? k4 + 1u : k4;
    [[dont_unroll]] for (uint s = begin + lane; s < end; s += gl_WorkGroupSize.x) {
        vec4 g0 = FETCH(dz, j4 * push.capacity + s);
        vec4 g1 = FETCH(dz, (j4 + 1u) * push.capacity + s);
        bias_sum[0] += g0;
        bias_sum[1] += g1;
        vec4 x0 = FETCH(inputs, k4 * push.capacity + s);
        vec4 x1 = FETCH(inputs, k4b * push.capacity + s);
        [[unroll]] for (uint j = 0u; j < 4u; j++) {
            sum[j][0] += g0[j] * x0;
            sum[j][1] += g0[j] * x1;
            sum[j + 4u][0] += g1[j] * x0;
            sum[j + 4u][1] += g1[j] * x1;
        }
    }
    [[unroll]] for (uint j = 0u; j < 8u; j++) {
        [[unroll]] for (uint k = 0u; k < 8u; k++) {
            lanes_sum[(j * 8u + k) * gl_WorkGroupSize.x + lane] = sum[j][k / 4u][k & 3u];
        }
    }
    barrier();
    for (uint e = lane; e < 64u; e += gl_WorkGroupSize.x) {
        uint k = e & 7u;
        if (k >= 4u && !second_inputs) continue;
        put(push.weights + (gl_WorkGroupID.x * 8u + e / 8u) * push.in_groups * 4u + k4 * 4u + k, over_lanes(e));
    }
    if (push.bias == ~0u || gl_WorkGroupID.y != 0u) return;
    barrier();
    [[unroll]] for (uint j = 0u; j < 8u; j++) {
        lanes_sum[j * gl_WorkGroupSize.x + lane] = bias_sum[j / 4u][j & 3u];
    }
    barrier();
    for (uint j = lane; j < 8u; j += gl_WorkGroupSize.x) put(push.bias + gl_WorkGroupID.x * 8u + j, over_lanes(j));
}
