// Static field (paper section 2.1): three vector-matrix modes, each a plane (first axis fast) times a line.
//   mode 0: plane XY, line Z;  mode 1: plane XZ, line Y;  mode 2: plane YZ, line X.
// Parameters: planes [mode][v][u][rank4] vec4, then lines [mode][w][rank4] vec4. The including file must declare `setup` and
// FETCH(static_params, i).

struct VmTaps {
    uint plane[4];
    float plane_weight[4];
    uint line[2];
    float line_weight[2];
};

bool static_inside(vec3 x) {
    return all(greaterThanEqual(x, setup.static_min)) && all(lessThanEqual(x, setup.static_max));
}

// Grid coordinate in [0, grid - 1]; the corners coincide with those of the box.
vec3 vm_coordinate(vec3 x) {
    return (x - setup.static_min) / (setup.static_max - setup.static_min) * float(setup.grid - 1u);
}

VmTaps vm_taps(vec3 coordinate, uint mode) {
    vec2 uv = mode == 0u ? coordinate.xy : (mode == 1u ? coordinate.xz : coordinate.yz);
    float w = mode == 0u ? coordinate.z : (mode == 1u ? coordinate.y : coordinate.x);
    uint last = setup.grid - 2u;
    uvec2 cell = min(uvec2(max(uv, vec2(0.0))), uvec2(last));
    uint line_cell = min(uint(max(w, 0.0)), last);
    vec2 f = uv - vec2(cell);
    float fw = w - float(line_cell);
    uint d = setup.grid;
    uint plane0 = mode * d * d + cell.y * d + cell.x;
    uint line0 = 3u * d * d + mode * d + line_cell;
    VmTaps taps;
    taps.plane[0] = plane0;
    taps.plane[1] = plane0 + 1u;
    taps.plane[2] = plane0 + d;
    taps.plane[3] = plane0 + d + 1u;
    taps.plane_weight[0] = (1.0 - f.x) * (1.0 - f.y);
    taps.plane_weight[1] = f.x * (1.0 - f.y);
    taps.plane_weight[2] = (1.0 - f.x) * f.y;
    taps.plane_weight[3] = f.x * f.y;
    taps.line[0] = line0;
    taps.line[1] = line0 + 1u;
    taps.line_weight[0] = 1.0 - fw;
    taps.line_weight[1] = fw;
    return taps;
}

vec4 vm_plane(VmTaps taps, uint r) {
    uint n = setup.rank4;
    return taps.plane_weight[0] * FETCH(static_params, taps.plane[0] * n + r)
         + taps.plane_weight[1] * FETCH(static_params, taps.plane[1] * n + r)
         + taps.plane_weight[2] * FETCH(static_params, taps.plane[2] * n + r)
         + taps.plane_weight[3] * FETCH(static_params, taps.plane[3] * n + r);
}

vec4 vm_line(VmTaps taps, uint r) {
    uint n = setup.rank4;
    return taps.line_weight[0] * FETCH(static_params, taps.line[0] * n + r)
         + taps.line_weight[1] * FETCH(static_params, taps.line[1] * n + r);
}

// Sum over modes and ranks before the activation.
float vm_feature(vec3 x) {
    vec3 coordinate = vm_coordinate(x);
    float sum = 0.0;
    for (uint mode = 0u; mode < 3u; mode++) {
        VmTaps taps = vm_taps(coordinate, mode);
        for (uint r = 0u; r < setup.rank4; r++) sum += dot(vm_plane(taps, r), vm_line(taps, r));
    }
    return sum;
}

float static_attenuation(vec3 x) {
    return setup.static_gain * softplus(vm_feature(x) + setup.static_shift);
}
