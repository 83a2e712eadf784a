// Record of the cells in which the dynamic field was empty during training. Each cell and phase has two bits in each of three
// epochs: bit 0, a sample was evaluated there; bit 1, a sample was not empty. The present and the previous epoch determine
// whether a cell is evaluated, while the third epoch is cleared. The including file must declare `setup` and `occupancy`.
const uint OCCUPANCY_EPOCH = 64u;    // number of iterations of an epoch
const uint SEEN = 1u;                // bit of a cell in which a sample was evaluated
const uint OCCUPIED = 2u;            // bit of a cell in which a sample was not empty
const uint OCCUPANCY_EPOCHS = 3u;    // number of epochs kept in turn
const uint CELLS_PER_WORD = 16u;     // number of cells of a word of the occupancy, two bits each
const float LITTLE_SHOWN = 0.25;     // share of a phase below which an empty sample is not recorded for it

// Number of words of one epoch.
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
