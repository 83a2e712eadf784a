#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Weight gradient dW[j][k] = sum_s dz[j][s] x[k][s], as partial sums per split of the samples. A lane keeps INPUTS inputs (one
// per lane and step of a workgroup) x NEURONS4 vec4 of neurons and processes the samples of its split; the loads of dz are
// uniform. One workgroup per (4 * NEURONS4 neurons, INPUTS * workgroup inputs, split). The workgroups of the first inputs also
// sum dz itself, which is the gradient of a bias.
//   partials[split][parameter]; later chunks of an iteration add to the values of the first chunk.
#include "inc/operands.glsl"
#include "inc/layout.glsl"
#include "inc/positions.glsl"
#ifndef NEURONS4
#define NEURONS4 4u
#endif
#ifndef INPUTS
#define INPUTS 4u
#endif
// Each update of a sum adds four products, because the sums are in memory on a device with too few registers.
#define STEP 4u
layout(local_size_x = 16, local_size_x_id = 0) in;
layout(push_constant) uniform Push {
    uint in_groups; uint weights; uint capacity; uint splits; uint n_partials; uint accumulate;
    uint bias;  // parameter that receives the sum of dz; NOWHERE: none
    uint out_groups;
    ADDRESS_OF(dz) ADDRESS_OF(inputs)
} push;
READ_VEC4(0, B0, dz);
READ_VEC4(1, B1, inputs);
layout(binding = 2) readonly buffer B2 { LiveSamples live; };
layout(binding = 3) buffer B3 { float partials[]; };

vec4 sum[NEURONS4][INPUTS];
vec4 bias_sum[NEURONS4];

void put(uint parameter, float total) {
    uint at = gl_WorkGroupID.z * push.n_partials + parameter;
    partials[at] = total + (push.accumulate != 0u ? partials[at] : 0.0);
}

// Tiles may extend beyond both sides. They then repeat the last vec4 and do not store it.
void walk(bool with_bias, uint j4, uint k0, uint begin, uint end) {
    uint row[NEURONS4];
    uint column[INPUTS];
    [[unroll]] for (uint j = 0u; j < NEURONS4; j++) row[j] = min(j4 + j, push.out_groups - 1u) * push.capacity;
    [[unroll]] for (uint i = 0u; i < INPUTS; i++) {
        column[i] = min((k0 + i * gl_WorkGroupSize.x) / 4u, push.in_groups - 1u) * push.capacity;
    }
    uint component = k0 & 3u;
    [[dont_unroll]] for (uint s = begin; s < end; s += STEP) {
        float x[INPUTS][STEP];
        [[unroll]] for (uint i = 0u; i < INPUTS; i++) {
            [[unroll]] for (uint e = 0u; e < STEP; e++) x[i][e] = FETCH(inputs, column[i] + s + e)[component];
        }
        [[unroll]] for (uint j = 0u; j < NEURONS4; j++) {
            vec4 g[STEP];
            [[unroll]] for (uint e = 0u; e < STEP; e++) g[e] = FETCH(dz, row[j] + s + e);
            if (with_bias) bias_sum[j] += (g[0] + g[1]) + (g[2] + g[3]);
            [[unroll]] for (uint i = 0u; i < INPUTS; i++) {
                sum[j][i] += (g[0] * x[i][0] + g[1] * x[i][1]) + (g[2] * x[i][2] + g[3] * x[i][3]);
            }
        }
    }
}

void main() {
    uint j4 = gl_WorkGroupID.x * NEURONS4;
    uint k0 = gl_WorkGroupID.y * INPUTS * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    uint per = (live.padded / STEP + push.splits - 1u) / push.splits * STEP;  // live.padded is a multiple of STEP
    uint begin = gl_WorkGroupID.z * per;
    uint end = min(begin + per, live.padded);
    [[unroll]] for (uint j = 0u; j < NEURONS4; j++) {
        bias_sum[j] = vec4(0.0);
        [[unroll]] for (uint i = 0u; i < INPUTS; i++) sum[j][i] = vec4(0.0);
    }
    bool with_bias = push.bias != NOWHERE && gl_WorkGroupID.y == 0u;
    if (with_bias) walk(true, j4, k0, begin, end);
    else walk(false, j4, k0, begin, end);
    [[unroll]] for (uint j = 0u; j < NEURONS4; j++) {
        if (j4 + j >= push.out_groups) continue;
        [[unroll]] for (uint c = 0u; c < 4u; c++) {
            uint neuron = 4u * (j4 + j) + c;
            [[unroll]] for (uint i = 0u; i < INPUTS; i++) {
                uint k = k0 + i * gl_WorkGroupSize.x;
                if (k < 4u * push.in_groups) put(push.weights + neuron * push.in_groups * 4u + k, sum[j][i][c]);
            }
            if (with_bias && gl_LocalInvocationID.x == 0u) put(push.bias + neuron, bias_sum[j][c]);
        }
    }
}
