// Where the dynamic field has been seen empty while training. Two bits per cell and phase, for three epochs in turn:
// bit 0, a sample was evaluated there; bit 1, one was not empty. The present epoch and the one before it decide, the
// third is being cleared. Needs `setup` and `occupancy`.
const uint OCCUPANCY_EPOCH = 64u;       // iterations
const uint SEEN = 1u;
const uint OCCUPIED = 2u;

// Words of one epoch.
uint occupancy_words() {
    uint n = setup.occupancy_cells;
    return (setup.n_phases * n * n * n + 15u) / 16u;
}

uint occupancy_entry(vec3 x, uint phase) {
    vec3 low = vec3(setup.dynamic_min_x, setup.dynamic_min_y, setup.dynamic_min_z);
    vec3 high = vec3(setup.dynamic_max_x, setup.dynamic_max_y, setup.dynamic_max_z);
    uint n = setup.occupancy_cells;
    uvec3 cell = min(uvec3(max((x - low) / (high - low) * float(n), vec3(0.0))), uvec3(n - 1u));
    return ((phase * n + cell.z) * n + cell.y) * n + cell.x;
}
