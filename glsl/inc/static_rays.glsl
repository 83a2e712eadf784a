// With a temporal target the dynamic field needs no static integral, so the rays drawn for motion do
// without it; the static field learns from the others. Needs `setup`.
bool skips_static(uint r) {
    return setup.temporal_target != 0u && r < setup.n_motion_rays && setup.n_motion_rays < setup.n_rays;
}

// Rays the static field learns from.
uint n_static_rays() {
    return skips_static(0u) ? setup.n_rays - setup.n_motion_rays : setup.n_rays;
}
