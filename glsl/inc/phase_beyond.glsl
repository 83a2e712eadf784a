// Second phase of a time between two phases: the phase after `phase`, or the one before it if `after_phase` is negative. The
// beat is periodic. The including file must declare `gaussian_setup`.
uint phase_beyond(uint phase, float after_phase) {
    uint n = gaussian_setup.n_phases;
    return (phase + (after_phase < 0.0 ? n - 1u : 1u)) % n;
}
