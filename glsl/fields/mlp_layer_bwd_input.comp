#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Gradient of the hidden input of one hidden layer: dz_in = (W_b^T dz) where the input neuron is positive. A lane keeps SAMPLES
// samples x GROUPS vec4 of inputs; the loads of the weights are uniform.
#include "inc/operands.glsl"
#include "inc/layout.glsl"
#ifndef SAMPLES
#define SAMPLES 4u
#endif
#ifndef GROUPS
#define GROUPS 4u
#endif
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push {
    uint out_groups; uint in_groups; uint weights4; uint capacity;
    ADDRESS_OF(dz) ADDRESS_OF(params)
} push;
READ_VEC4(0, B0, dz);
READ_VEC4(1, B1, params);
layout(binding = 2) readonly buffer B2 { vec4 activations[]; };
layout(binding = 3) readonly buffer B3 { LiveSamples live; };
layout(binding = 4) writeonly buffer B4 { vec4 dz_in[]; };

void main() {
    uint base = gl_WorkGroupID.x * (gl_WorkGroupSize.x * SAMPLES) + gl_LocalInvocationID.x;
    uint first = gl_WorkGroupID.y * GROUPS;
    uint padded = live.padded;
    vec4 sum[GROUPS][SAMPLES];
    [[unroll]] for (uint i = 0u; i < GROUPS; i++) {
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++) sum[i][t] = vec4(0.0);
    }
    [[dont_unroll]] for (uint q = 0u; q < push.out_groups; q++) {
        vec4 g[SAMPLES];
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++) {
            g[t] = FETCH(dz, q * push.capacity + min(base + t * gl_WorkGroupSize.x, padded - 1u));
        }
        uint row = push.weights4 + 4u * q * push.in_groups;
        [[unroll]] for (uint i = 0u; i < GROUPS; i++) {
            // A tile may extend beyond the width. It then repeats the last inputs and does not store them.
            uint at = row + min(first + i, push.in_groups - 1u);
            vec4 w0 = FETCH(params, at);
            vec4 w1 = FETCH(params, at + push.in_groups);
            vec4 w2 = FETCH(params, at + 2u * push.in_groups);
            vec4 w3 = FETCH(params, at + 3u * push.in_groups);
            // Each update of a sum adds four products, because the sums are in memory on a device with too few registers.
            [[unroll]] for (uint t = 0u; t < SAMPLES; t++) {
                sum[i][t] += g[t].x * w0 + g[t].y * w1 + g[t].z * w2 + g[t].w * w3;
            }
        }
    }
    [[unroll]] for (uint t = 0u; t < SAMPLES; t++) {
        uint s = base + t * gl_WorkGroupSize.x;
        if (s >= padded) continue;
        [[unroll]] for (uint i = 0u; i < GROUPS; i++) {
            if (first + i < push.in_groups) {
                uint at = (first + i) * push.capacity + s;
                dz_in[at] = sum[i][t] * vec4(greaterThan(activations[at], vec4(0.0)));
            }
        }
    }
}
