// Whether a sample is evaluated. Empty cells are evaluated in one of eight iterations on average, so that vessels can reappear.
#include "inc/occupancy.glsl"

bool occupied(vec3 x, uint phase, uint step) {
    if (setup.occupancy_cells == 0u || step < setup.occupancy_start) return true;
    uint entry = occupancy_entry(x, phase);
    uint epoch = step / OCCUPANCY_EPOCH;
    uint word = occupancy[(epoch % OCCUPANCY_EPOCHS) * occupancy_words() + entry / CELLS_PER_WORD]
              | occupancy[((epoch + OCCUPANCY_EPOCHS - 1u) % OCCUPANCY_EPOCHS) * occupancy_words() + entry / CELLS_PER_WORD];
    uint bits = word >> (2u * (entry % CELLS_PER_WORD));
    if ((bits & SEEN) == 0u || (bits & OCCUPIED) != 0u) return true;
    return (pcg4d(uvec4(setup.seed, STREAM_OCCUPANCY, step, entry)).x & 7u) == 0u;
}
