// Deformable set of Gaussians, a single set for all phases of the beat: each Gaussian moves by the displacement of a grid, with
// free values at each phase, and by harmonics of its own. Reference implementation: crates/twins/src/reference/dynamic_gaussians.rs.

// Position on the grid, in node distances from its first node.
vec3 on_grid(vec3 position, MotionGridSetup deformable) {
    float last = float(deformable.n_nodes) - 1.001;
    return clamp((position + deformable.half_side) * deformable.inverse_step, vec3(0.0), vec3(last));
}

// Interpolation weight of a node's displacement at a place on the grid.
float node_share(vec3 place, uvec3 node) {
    vec3 w = max(vec3(0.0), 1.0 - abs(place - vec3(node)));
    return w.x * w.y * w.z;
}

uint node_index(uvec3 node, MotionGridSetup deformable) {
    return (node.z * deformable.n_nodes + node.y) * deformable.n_nodes + node.x;
}
