// Where a Gaussian of the tree is; needs `gaussian_setup`, `tree_setup`, `motion_grid`, `own_motion` and `motion_basis`.

// At a phase.
vec3 position_at(uint i, vec3 rest, uint phase) {
    vec3 place = on_grid(rest, tree_setup);
    uvec3 first = uvec3(floor(place));
    uint n_nodes = tree_setup.n_nodes * tree_setup.n_nodes * tree_setup.n_nodes;
    vec3 x = rest;
    for (uint corner = 0u; corner < 8u; corner++) {
        uvec3 node = first + uvec3(corner & 1u, (corner >> 1) & 1u, corner >> 2);
        x += node_share(place, node) * motion_grid[phase * n_nodes + node_index(node, tree_setup)].xyz;
    }
    for (uint k = 0u; k < tree_setup.n_basis; k++)
        x += motion_basis[phase * tree_setup.n_basis + k] * own_motion[i * tree_setup.n_basis + k].xyz;
    return x;
}

// The phase that lies beyond a time between two: after the phase, or before it. The beat closes.
uint phase_beyond(uint phase, float after_phase) {
    uint n = gaussian_setup.n_phases;
    return (phase + (after_phase < 0.0 ? n - 1u : 1u)) % n;
}

// On the straight way from `here`, its place at a phase, to where it is at the phase beyond.
vec3 position_between(uint i, vec3 rest, vec3 here, uint phase, float after_phase) {
    if (after_phase == 0.0) return here;
    return mix(here, position_at(i, rest, phase_beyond(phase, after_phase)), abs(after_phase));
}
