#version 450
#extension GL_GOOGLE_include_directive : require
// Gradients of the bias and the latent weights of a layer that reads the encoding, and of the latents, from the layer's sums of
// dz per phase. There is one dispatch per such layer; the gradients of the latents are added up. One invocation per element of
// [bias | latent_weight | latents].
#include "inc/layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push {
    uint layer; uint bias; uint latent_weight; uint latents; uint accumulate_latents;
} push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { float params[]; };
layout(binding = 2) readonly buffer B2 { float phase_dz[]; };
layout(binding = 3) buffer B3 { float gradient[]; };

float dz(uint phase, uint j) {
    return phase_dz[(push.layer * setup.n_phases + phase) * setup.mlp_width + j];
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    uint width = setup.mlp_width;
    uint latent = setup.latent_width;
    float sum = 0.0;
    if (i < width) {
        for (uint p = 0u; p < setup.n_phases; p++) sum += dz(p, i);
        gradient[push.bias + i] = sum;
        return;
    }
    i -= width;
    if (i < width * latent) {
        uint j = i / latent;
        uint l = i % latent;
        for (uint p = 0u; p < setup.n_phases; p++) sum += dz(p, j) * params[push.latents + p * latent + l];
        gradient[push.latent_weight + i] = sum;
        return;
    }
    i -= width * latent;
    if (i < setup.n_phases * latent) {
        uint p = i / latent;
        uint l = i % latent;
        for (uint j = 0u; j < width; j++) sum += dz(p, j) * params[push.latent_weight + j * latent + l];
        gradient[push.latents + i] = sum + (push.accumulate_latents != 0u ? gradient[push.latents + i] : 0.0);
    }
}
