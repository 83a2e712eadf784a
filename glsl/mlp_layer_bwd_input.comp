#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Gradient through one hidden layer to its hidden input: dz_in = (W_b^T dz) where the input neuron was on.
// A lane keeps SAMPLES samples x GROUPS vec4 of inputs; weights are uniform loads.
#include "inc/layout.glsl"
#include "inc/texels.glsl"
#ifndef SAMPLES
#define SAMPLES 4u
#endif
#ifndef GROUPS
#define GROUPS 4u
#endif
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint out_groups; uint in_groups; uint weights4; uint capacity; } push;
READ_VEC4(0, B0, dz);
READ_VEC4(1, B1, params);
READ_VEC4(2, B2, activations);
layout(binding = 3) readonly buffer B3 { uint live[]; };
layout(binding = 4) writeonly buffer B4 { vec4 dz_in[]; };

void main() {
    uint base = gl_WorkGroupID.x * (gl_WorkGroupSize.x * SAMPLES) + gl_LocalInvocationID.x;
    uint first = gl_WorkGroupID.y * GROUPS;
    uint padded = live[1];
    vec4 sum[GROUPS][SAMPLES];
    [[unroll]] for (uint i = 0u; i < GROUPS; i++) {
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++) sum[i][t] = vec4(0.0);
    }
    [[dont_unroll]] for (uint q = 0u; q < push.out_groups; q++) {
        vec4 g[SAMPLES];
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++) {
            g[t] = FETCH(dz, q * push.capacity + min(base + t * gl_WorkGroupSize.x, padded - 1u));
        }
        [[unroll]] for (uint j = 0u; j < 4u; j++) {
            uint row = push.weights4 + (4u * q + j) * push.in_groups + first;
            [[unroll]] for (uint i = 0u; i < GROUPS; i++) {
                vec4 w = FETCH(params, row + i);
                [[unroll]] for (uint t = 0u; t < SAMPLES; t++) sum[i][t] += g[t][j] * w;
            }
        }
    }
    [[unroll]] for (uint t = 0u; t < SAMPLES; t++) {
        uint s = base + t * gl_WorkGroupSize.x;
        if (s < padded) {
            [[unroll]] for (uint i = 0u; i < GROUPS; i++) {
                uint at = (first + i) * push.capacity + s;
                dz_in[at] = sum[i][t] * vec4(greaterThan(FETCH(activations, at), vec4(0.0)));
            }
        }
    }
}
