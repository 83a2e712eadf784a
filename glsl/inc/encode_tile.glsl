// Input of a sample for the kernels on matrices: [encoding, shares of the phases, zeros] in f16. The including file must
// declare `setup`, `schedule`, `state`, `live`, `sample_points`, `sample_rays`, `rays`, and `encoded`, the padded number of
// inputs.
#include "inc/encoding.glsl"

const float QUARTER_TURN = 1.5707963267948966;

// Number i of a sample's input: the encoding, followed by the shares of the phases and zeros.
float input_number(uint i, vec3 x, Ray ray, float window) {
    if (i < 3u) return x[i];
    uint band = (i - 3u) / 6u;
    if (band < setup.n_bands) {
        uint part = (i - 3u) % 6u;
        float angle = reduce_angle(vec3(x[part % 3u] * float(1u << band))).x;
        // The cosine is a shifted sine, so that lanes with a cosine and lanes with a sine execute the same instructions.
        return clamp(window - float(band), 0.0, 1.0) * sin(part < 3u ? angle : angle + QUARTER_TURN);
    }
    return phase_share(ray, i - 3u - 6u * setup.n_bands);
}

// Eight numbers of a sample's input, from 8 q on. Samples from `live.count` on have zeros.
uvec4 encoded_numbers(uint s, uint q) {
    uvec4 packed = uvec4(0u);
    if (s >= live.count) return packed;
    float window = schedule[state.step].window;
    vec3 x = encoded_point(sample_points[s].xyz);
    Ray ray = rays[ray_of(sample_rays[s])];
    [[dont_unroll]] for (uint pair = 0u; pair < 4u; pair++) {
        uint i = 8u * q + 2u * pair;
        packed[pair] = pack2(vec2(input_number(i, x, ray, window), input_number(i + 1u, x, ray, window)));
    }
    return packed;
}
