#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Backward pass through one linear layer of the Lineformer, or through two with the same input, on a chunk of samples: to =
// slope (W^T from + V^T other). The slope is that of the activation before the layer's input. A lane keeps SAMPLES samples x
// GROUPS vec4 of inputs; the loads of the weights are uniform.
#include "inc/operands.glsl"
#ifndef SAMPLES
#define SAMPLES 4u
#endif
#ifndef GROUPS
#define GROUPS 4u
#endif
layout(local_size_x = 32, local_size_x_id = 0) in;
// `from`, `other`, `to` and `slope_of` are vectors. A matrix begins at `weights`, with `stride` from row to row, both in vec4,
// and has `rows4` groups of four rows. `slope_of` is the activation's result (leaky) or its argument (GELU). With `to` =
// SAX_FEATURES the output has the layout in which `sax_linear` reads the features.
layout(push_constant) uniform Push {
    uint n_samples; uint capacity; uint first_feature; uint feature_stride; uint from; uint rows4; uint weights; uint stride;
    uint other; uint other_rows4; uint other_weights; uint other_stride; uint to; uint columns; uint activation;
    uint slope_of;
} push;
READ_VEC4(0, B0, sax_params);
READ_VEC4(1, B1, sax_operands);
layout(binding = 2) writeonly buffer B2 { vec4 sax_vectors[]; };
layout(binding = 3) writeonly buffer B3 { vec4 sax_encoding_gradient[]; };
#include "inc/lineformer.glsl"

vec4 sum[GROUPS][SAMPLES];
uint base;
uint first;

void add(uint from, uint rows4, uint weights, uint stride) {
    [[dont_unroll]] for (uint q = 0u; q < rows4; q++) {
        vec4 g[SAMPLES];
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++)
            g[t] = operand(from, q, min(base + t * gl_WorkGroupSize.x, push.n_samples - 1u));
        uint row = weights + 4u * q * stride;
        [[unroll]] for (uint i = 0u; i < GROUPS; i++) {
            // A tile may extend beyond the columns. It then repeats the last inputs and does not store them.
            uint at = row + min(first + i, push.columns - 1u);
            vec4 w0 = FETCH(sax_params, at);
            vec4 w1 = FETCH(sax_params, at + stride);
            vec4 w2 = FETCH(sax_params, at + 2u * stride);
            vec4 w3 = FETCH(sax_params, at + 3u * stride);
            [[unroll]] for (uint t = 0u; t < SAMPLES; t++)
                sum[i][t] += g[t].x * w0 + g[t].y * w1 + g[t].z * w2 + g[t].w * w3;
        }
    }
}

void main() {
    base = gl_WorkGroupID.x * (gl_WorkGroupSize.x * SAMPLES) + gl_LocalInvocationID.x;
    first = gl_WorkGroupID.y * GROUPS;
    [[unroll]] for (uint i = 0u; i < GROUPS; i++) {
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++) sum[i][t] = vec4(0.0);
    }
    add(push.from, push.rows4, push.weights, push.stride);
    add(push.other, push.other_rows4, push.other_weights, push.other_stride);
    [[unroll]] for (uint t = 0u; t < SAMPLES; t++) {
        uint s = base + t * gl_WorkGroupSize.x;
        if (s >= push.n_samples) continue;
        [[unroll]] for (uint k = 0u; k < GROUPS; k++) {
            uint i = first + k;
            if (i >= push.columns) continue;
            vec4 value = sum[k][t];
            if (push.activation == SAX_LEAKY) value *= leaky_slope(operand(push.slope_of, i, s));
            if (push.activation == SAX_GELU) value *= gelu_slope(operand(push.slope_of, i, s));
            if (push.to == SAX_FEATURES) {
                sax_encoding_gradient[i * push.feature_stride + push.first_feature + s] = value;
            } else {
                sax_vectors[place_of(push.to, i, s)] = value;
            }
        }
    }
}
