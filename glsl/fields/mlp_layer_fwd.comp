#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// One hidden layer: activations = relu(W_a input_a + W_b input_b + bias). The bias is that of the sample's phase,
// phase_bias[phase], or an interpolation between two phases. A lane keeps SAMPLES samples x OUTPUTS neurons in registers; the
// loads of the weights are uniform.
//   input_*[q * capacity + s], activations[q * capacity + s]: vec4 of 4 consecutive features.
//   The weights are row-major [out][in], with 4 inputs per vec4.
#include "inc/operands.glsl"
#include "inc/layout.glsl"
#ifndef SAMPLES
#define SAMPLES 4u
#endif
#ifndef OUTPUTS
#define OUTPUTS 16u
#endif
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push {
    uint a_groups; uint b_groups; uint a_weights4; uint b_weights4; uint bias; uint capacity; uint width;
    ADDRESS_OF(input_a) ADDRESS_OF(input_b) ADDRESS_OF(params)
} push;
READ_VEC4(0, B0, input_a);
READ_VEC4(1, B1, input_b);
READ_VEC4(2, B2, params);
layout(binding = 3) readonly buffer B3 { LiveSamples live; };
layout(binding = 4) readonly buffer B4 { SampleTime sample_times[]; };
layout(binding = 5) readonly buffer B5 { vec4 phase_bias[]; };
layout(binding = 6) writeonly buffer B6 { vec4 activations[]; };

// Widths are multiples of 16. A wider tile may extend beyond the width; it then repeats the last neuron and does not store it.
#define ROW(J) min(first + (J), push.width - 1u)
#define ADD_INPUT(INPUT, GROUPS, WEIGHTS4)                                                                  \
    [[dont_unroll]] for (uint q = 0u; q < GROUPS; q++) {                                                    \
        vec4 x[SAMPLES];                                                                                    \
        [[unroll]] for (uint t = 0u; t < SAMPLES; t++) x[t] = FETCH(INPUT, q * push.capacity + sample_of(t)); \
        [[unroll]] for (uint j = 0u; j < OUTPUTS; j++) {                                                    \
            vec4 w = FETCH(params, WEIGHTS4 + ROW(j) * GROUPS + q);                                         \
            [[unroll]] for (uint t = 0u; t < SAMPLES; t++) sum[j][t] += dot(w, x[t]);                       \
        }                                                                                                   \
    }

uint base;
uint padded;

uint sample_of(uint t) {
    return min(base + t * gl_WorkGroupSize.x, padded - 1u);
}

// Position of the biases of four neurons of a phase, from `neuron` on.
uint bias_at(uint phase, uint neuron) {
    return (push.bias + phase * push.width + min(neuron, push.width - 4u)) / 4u;
}

void main() {
    base = gl_WorkGroupID.x * (gl_WorkGroupSize.x * SAMPLES) + gl_LocalInvocationID.x;
    padded = live.padded;
    uint first = gl_WorkGroupID.y * OUTPUTS;
    float sum[OUTPUTS][SAMPLES];
    [[unroll]] for (uint t = 0u; t < SAMPLES; t++) {
        SampleTime taken = sample_times[sample_of(t)];
        [[unroll]] for (uint j = 0u; j < OUTPUTS; j += 4u) {
            vec4 bias = phase_bias[bias_at(taken.phase, first + j)];
            sum[j][t] = bias.x;
            sum[j + 1u][t] = bias.y;
            sum[j + 2u][t] = bias.z;
            sum[j + 3u][t] = bias.w;
        }
        if (taken.beyond_share == 0.0) continue;
        [[unroll]] for (uint j = 0u; j < OUTPUTS; j += 4u) {
            vec4 bias = vec4(sum[j][t], sum[j + 1u][t], sum[j + 2u][t], sum[j + 3u][t]);
            bias = mix(bias, phase_bias[bias_at(taken.beyond, first + j)], taken.beyond_share);
            sum[j][t] = bias.x;
            sum[j + 1u][t] = bias.y;
            sum[j + 2u][t] = bias.z;
            sum[j + 3u][t] = bias.w;
        }
    }
    ADD_INPUT(input_a, push.a_groups, push.a_weights4)
    ADD_INPUT(input_b, push.b_groups, push.b_weights4)
    [[unroll]] for (uint t = 0u; t < SAMPLES; t++) {
        uint s = base + t * gl_WorkGroupSize.x;
        if (s >= padded) continue;
        [[unroll]] for (uint j = 0u; j < OUTPUTS; j += 4u) {
            if (first + j < push.width) {
                activations[(first + j) / 4u * push.capacity + s] =
                    max(vec4(sum[j][t], sum[j + 1u][t], sum[j + 2u][t], sum[j + 3u][t]), 0.0);
            }
        }
    }
}
