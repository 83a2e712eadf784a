#version 450
#extension GL_GOOGLE_include_directive : require
// Bias and latent act as one row per phase, and between two phases as what lies between their rows:
//   phase_bias[layer][phase][j] = bias[j] + sum_l latent_weight[j][l] * latent[phase][l].
// One invocation per (layer, phase, neuron).
//   network_layers[layer]: where its bias and its weights on latents are; NOWHERE: it has none of these.
#include "inc/layout.glsl"
#include "inc/positions.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint layers; uint latents; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { float params[]; };
layout(binding = 2) readonly buffer B2 { uvec2 network_layers[]; };
layout(binding = 3) writeonly buffer B3 { float phase_bias[]; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= push.layers * setup.n_phases * setup.mlp_width) return;
    uvec2 layer = network_layers[i / (setup.n_phases * setup.mlp_width)];
    uint phase = i / setup.mlp_width % setup.n_phases;
    uint j = i % setup.mlp_width;
    float sum = params[layer.x + j];
    if (layer.y != NOWHERE) {
        for (uint l = 0u; l < setup.latent_width; l++) {
            sum += params[layer.y + j * setup.latent_width + l] * params[push.latents + phase * setup.latent_width + l];
        }
    }
    phase_bias[i] = sum;
}
