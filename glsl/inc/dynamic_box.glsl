// Region in which the dynamic field may exist: its box and, if enabled, the motion hull. The including file must declare
// `setup` and `hull`.
bool dynamic_inside(vec3 x, uint phase) {
    if (any(lessThan(x, setup.dynamic_min)) || any(greaterThan(x, setup.dynamic_max))) return false;
    if (setup.hull_enabled == 0u) return true;
    ivec3 cell = ivec3(floor((x - setup.hull_min) * setup.hull_inv_cell));
    ivec3 size = ivec3(setup.hull_size);
    if (any(lessThan(cell, ivec3(0))) || any(greaterThanEqual(cell, size))) return false;
    uint index = uint((cell.z * size.y + cell.y) * size.x + cell.x);
    return (hull[phase * setup.hull_phase_words + (index >> 5u)] & (1u << (index & 31u))) != 0u;
}
