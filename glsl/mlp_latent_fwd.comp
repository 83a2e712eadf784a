#version 450
#extension GL_GOOGLE_include_directive : require
// Bias and latent act as one row per phase, and between two phases as what lies between their rows:
//   phase_bias[layer][phase][j] = bias[j] + sum_l latent_weight[j][l] * latent[phase][l].
// One invocation per (phase, neuron); one dispatch per layer.
#include "inc/layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint layer; uint bias; uint latent_weight; uint has_latent; uint latents; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { float params[]; };
layout(binding = 2) writeonly buffer B2 { float phase_bias[]; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= setup.n_phases * setup.mlp_width) return;
    uint phase = i / setup.mlp_width;
    uint j = i % setup.mlp_width;
    float sum = params[push.bias + j];
    if (push.has_latent != 0u) {
        for (uint l = 0u; l < setup.latent_width; l++) {
            sum += params[push.latent_weight + j * setup.latent_width + l]
                 * params[push.latents + phase * setup.latent_width + l];
        }
    }
    phase_bias[push.layer * setup.n_phases * setup.mlp_width + i] = sum;
}
