#version 450
#extension GL_GOOGLE_include_directive : require
// f16 copies of the network's weights as the fused kernels read them, bias and latent of each phase among them
// (inc/phase_bias.glsl), and f32 biases repeated over the rows of a product. One invocation per pair of f16, then one per bias
// element.
//   pack_source[i]: where element i comes from: a parameter; PHASE_BIAS | element of [layer][phase][neuron]; or NOWHERE, zero.
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
