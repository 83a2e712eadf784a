// The bias and the latent of a layer together form one row per phase; between two phases, the rows are interpolated:
//   row[layer][phase][j] = bias[j] + sum_l latent_weight[j][l] * latent[phase][l].
// The including file must declare `setup`, `params`, and network_layers[layer]: positions of the layer's bias and of its
// weights of the latents; NOWHERE if it has no weights of latents.

// Element i of [layer][phase][neuron]; the network's latents begin at parameter `latents`.
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
