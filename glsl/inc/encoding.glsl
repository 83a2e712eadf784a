// Windowed positional encoding (paper section 2.3): [x, y, z, then per band k: a_k sin(2^k (x,y,z)), a_k cos(...)]. The
// including file must declare `setup`.

// The sin of Vulkan is accurate only near 0, so this function subtracts the nearest multiple n of 2 pi in three parts. The
// products of n with the first two parts are exact. `precise` prevents compilers from adding the parts up first.
vec3 reduce_angle(vec3 a) {
    vec3 n = round(a * 0.15915494309189535);
    precise vec3 less = a - n * 6.28125;
    precise vec3 still_less = less - n * 0.0019350051879882812;
    return still_less - n * 3.01991598e-7;
}

vec3 encoded_point(vec3 x) {
    return (x - setup.encode_centre) * setup.encode_scale;
}

void encoded_band(vec3 x, uint band, float window, out vec3 sines, out vec3 cosines) {
    vec3 angle = reduce_angle(x * float(1u << band));
    float open = clamp(window - float(band), 0.0, 1.0);
    sines = open * sin(angle);
    cosines = open * cos(angle);
}
