// Filling of the Gaussians of the deformable set, [Gaussian][phase]: the share of its density at rest that a Gaussian shows at a
// phase. The including file must declare `gaussian_setup` and `filling`. Reference implementation:
// src/methods/dynamic_gaussians/twin.rs.
#include "inc/phase_beyond.glsl"

// Filling in an image taken `after_phase` after a phase, interpolated linearly as positions are.
float filling_at(uint i, uint phase, float after_phase) {
    uint first = i * gaussian_setup.n_phases;
    float here = filling[first + phase];
    if (after_phase == 0.0) return here;
    return mix(here, filling[first + phase_beyond(phase, after_phase)], abs(after_phase));
}
