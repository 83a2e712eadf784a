// Bias and latent act as one row per phase, and between two phases as what lies between their rows:
//   row[layer][phase][j] = bias[j] + sum_l latent_weight[j][l] * latent[phase][l].
// Needs `setup`, `params`, and network_layers[layer]: where its bias and its weights on latents are; NOWHERE: it has none of these.

// Element i of [layer][phase][neuron], with the network's latents from parameter `latents` on.
float phase_bias_at(uint i, uint latents) {
    uvec2 layer = network_layers[i / (setup.n_phases * setup.mlp_width)];
    uint phase = i / setup.mlp_width % setup.n_phases;
    uint j = i % setup.mlp_width;
    float sum = params[layer.x + j];
    if (layer.y == NOWHERE) return sum;
    for (uint l = 0u; l < setup.latent_width; l++) {
        sum += params[layer.y + j * setup.latent_width + l] * params[latents + phase * setup.latent_width + l];
    }
    return sum;
}
