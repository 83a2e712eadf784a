// With a temporal target the dynamic field needs no static integral, so the rays drawn for motion skip the static field, which
// is trained by the other rays. The including file must declare `setup`.
bool skips_static(uint r) {
    return setup.temporal_target != 0u && r < setup.n_motion_rays && setup.n_motion_rays < setup.n_rays;
}

// Number of rays that train the static field.
uint n_static_rays() {
    return skips_static(0u) ? setup.n_rays - setup.n_motion_rays : setup.n_rays;
}
