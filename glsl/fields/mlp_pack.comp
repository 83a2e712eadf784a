#version 450
#extension GL_GOOGLE_include_directive : require
// Copies in f16 of the network's weights for the fused kernels, including the bias plus latent term of each phase
// (inc/phase_bias.glsl), and biases in f32, repeated over the rows of a matrix product. One invocation per pair of f16,
// followed by one per bias element.
//   pack_source[i]: source of element i: a parameter; PHASE_BIAS | element of [layer][phase][neuron]; or NOWHERE for zero.
#include "inc/layout.glsl"
#include "inc/positions.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_pairs; uint n_bias; uint latents; } push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { float params[]; };
layout(binding = 2) readonly buffer B2 { uvec2 network_layers[]; };
layout(binding = 3) readonly buffer B3 { uint pack_source[]; };
layout(binding = 4) writeonly buffer B4 { uint weights16[]; };
layout(binding = 5) writeonly buffer B5 { float bias_rows[]; };
#include "inc/phase_bias.glsl"

float value(uint i) {
    uint source = pack_source[i];
    if (source == NOWHERE) return 0.0;
    return (source & PHASE_BIAS) != 0u ? phase_bias_at(source & ~PHASE_BIAS, push.latents) : params[source];
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i < push.n_pairs) {
        weights16[i] = packHalf2x16(clamp(vec2(value(2u * i), value(2u * i + 1u)), vec2(-65504.0), vec2(65504.0)));
    } else if (i < push.n_pairs + push.n_bias) {
        bias_rows[i - push.n_pairs] = value(i + push.n_pairs);
    }
}
