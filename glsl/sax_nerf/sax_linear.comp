#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// A linear layer of the Lineformer on a chunk of samples: to = activation(added + bias + W_f features + W from). The weights of
// the features come first in each row. A lane keeps SAMPLES samples x OUTPUTS numbers in registers; the loads of the weights
// are uniform.
#include "inc/operands.glsl"
#ifndef SAMPLES
#define SAMPLES 4u
#endif
#ifndef OUTPUTS
#define OUTPUTS 16u
#endif
layout(local_size_x = 32, local_size_x_id = 0) in;
// `from`, `added`, `to` and `activated` are vectors of inc/lineformer_layout.glsl. `weights` and `bias` are positions in vec4.
// `first_feature` is the position of the chunk's first sample in a row of `feature_stride` samples.
layout(push_constant) uniform Push {
    uint n_samples; uint capacity; uint features4; uint first_feature; uint feature_stride; uint from; uint columns;
    uint weights; uint bias; uint has_bias; uint added; uint to; uint activation; uint activated;
} push;
READ_VEC4(0, B0, sax_params);
READ_VEC4(1, B1, sax_encoding);
READ_VEC4(2, B2, sax_operands);
layout(binding = 3) writeonly buffer B3 { vec4 sax_vectors[]; };
#include "inc/lineformer.glsl"

float sum[OUTPUTS][SAMPLES];
uint base;

uint sample_of(uint t) { return min(base + t * gl_WorkGroupSize.x, push.n_samples - 1u); }

void add(uint weights, vec4 x[SAMPLES]) {
    uint stride = push.features4 + push.columns;
    [[unroll]] for (uint j = 0u; j < OUTPUTS; j++) {
        vec4 w = FETCH(sax_params, weights + j * stride);
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++) sum[j][t] += dot(w, x[t]);
    }
}

void main() {
    base = gl_WorkGroupID.x * (gl_WorkGroupSize.x * SAMPLES) + gl_LocalInvocationID.x;
    uint first = gl_WorkGroupID.y * OUTPUTS;
    [[unroll]] for (uint j = 0u; j < OUTPUTS; j += 4u) {
        vec4 bias = push.has_bias != 0u ? FETCH(sax_params, push.bias + (first + j) / 4u) : vec4(0.0);
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++) {
            [[unroll]] for (uint c = 0u; c < 4u; c++) sum[j + c][t] = bias[c];
        }
    }
    uint weights = push.weights + first * (push.features4 + push.columns);
    vec4 x[SAMPLES];
    [[dont_unroll]] for (uint q = 0u; q < push.features4; q++) {
        uint place = q * push.feature_stride + push.first_feature;
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++) x[t] = FETCH(sax_encoding, place + sample_of(t));
        add(weights + q, x);
    }
    [[dont_unroll]] for (uint q = 0u; q < push.columns; q++) {
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++) x[t] = operand(push.from, q, sample_of(t));
        add(weights + push.features4 + q, x);
    }
    [[unroll]] for (uint t = 0u; t < SAMPLES; t++) {
        uint s = base + t * gl_WorkGroupSize.x;
        if (s >= push.n_samples) continue;
        [[unroll]] for (uint j = 0u; j < OUTPUTS; j += 4u) {
            uint i = (first + j) / 4u;
            vec4 value = vec4(sum[j][t], sum[j + 1u][t], sum[j + 2u][t], sum[j + 3u][t]);
            if (push.added != SAX_NONE) value += operand(push.added, i, s);
            if (push.activation == SAX_LEAKY) value = leaky(value);
            sax_vectors[place_of(push.to, i, s)] = value;
            if (push.activation == SAX_GELU) sax_vectors[place_of(push.activated, i, s)] = gelu(value);
        }
    }
}
