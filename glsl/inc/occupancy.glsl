// Where the dynamic field has been seen empty while training. Two bits per cell and phase, for three epochs in turn:
// bit 0, a sample was evaluated there; bit 1, one was not empty. The present epoch and the one before it decide, the
// third is being cleared. Needs `setup` and `occupancy`.
const uint OCCUPANCY_EPOCH = 64u;    // iterations of an epoch
const uint SEEN = 1u;                // a sample was evaluated in the cell
const uint OCCUPIED = 2u;            // one was not empty
const uint OCCUPANCY_EPOCHS = 3u;    // kept, in turn
const uint CELLS_PER_WORD = 16u;     // of occupancy, two bits each
const float LITTLE_SHOWN = 0.25;     // share of a phase below which an empty sample tells nothing of it

// Words of one epoch.
uint occupancy_words() {
    uint n = setup.occupancy_cells;
    return (setup.n_phases * n * n * n + CELLS_PER_WORD - 1u) / CELLS_PER_WORD;
}

uint occupancy_entry(vec3 x, uint phase) {
    uint n = setup.occupancy_cells;
    vec3 within = (x - setup.dynamic_min) / (setup.dynamic_max - setup.dynamic_min);
    uvec3 cell = min(uvec3(max(within * float(n), vec3(0.0))), uvec3(n - 1u));
    return ((phase * n + cell.z) * n + cell.y) * n + cell.x;
}
