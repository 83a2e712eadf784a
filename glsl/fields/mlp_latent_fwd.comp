#version 450
#extension GL_GOOGLE_include_directive : require
// Bias plus latent term of all phases for the layers in f32 (inc/phase_bias.glsl). One invocation per (layer, phase, neuron).
#include "inc/layout.glsl"
#include "inc/positions.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint layers; uint latents; } push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { float params[]; };
layout(binding = 2) readonly buffer B2 { uvec2 network_layers[]; };
layout(binding = 3) writeonly buffer B3 { float phase_bias[]; };
#include "inc/phase_bias.glsl"

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i < push.layers * setup.n_phases * setup.mlp_width) phase_bias[i] = phase_bias_at(i, push.latents);
}
