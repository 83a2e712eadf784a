// Where a Gaussian of the tree is at a phase; needs `tree_setup`, `motion_grid`, `own_motion` and `motion_basis`.
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
