// Operations of SAX-NeRF's Lineformer on vectors of a chunk of samples. The including file must declare `push.capacity`,
// `sax_operands` for reading vectors and `sax_vectors` for writing them; both are the same memory.
//   sax_vectors[(8 * vector + number / 4) * capacity + sample]
#include "inc/lineformer_layout.glsl"

const float LEAK = 0.01;
const float MIN_VARIANCE = 1e-5;
const uint WIDTH4 = 8u;         // vec4 of a vector of 32 numbers

uint place_of(uint vector, uint i, uint s) { return (WIDTH4 * vector + i) * push.capacity + s; }

vec4 operand(uint vector, uint i, uint s) { return FETCH(sax_operands, place_of(vector, i, s)); }

vec4 leaky(vec4 x) { return max(x, LEAK * x); }

// Slope of the activation from its result, which has the sign of its argument.
vec4 leaky_slope(vec4 result) { return mix(vec4(LEAK), vec4(1.0), greaterThan(result, vec4(0.0))); }

// Cumulative standard normal distribution (Abramowitz and Stegun 7.1.26, maximum error 8e-8).
vec4 normal_share(vec4 x) {
    vec4 t = 1.0 / (1.0 + 0.2316418882663604 * abs(x));
    vec4 tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    tail *= 0.5 * exp(-0.5 * x * x);
    return mix(tail, 1.0 - tail, greaterThanEqual(x, vec4(0.0)));
}

vec4 gelu(vec4 x) { return x * normal_share(x); }

vec4 gelu_slope(vec4 x) { return normal_share(x) + x * 0.3989422804014327 * exp(-0.5 * x * x); }

// Mean of a sample's numbers, and the inverse of their standard deviation.
vec2 moments_of(vec4 x[WIDTH4]) {
    vec4 sum = vec4(0.0), squares = vec4(0.0);
    [[unroll]] for (uint i = 0u; i < WIDTH4; i++) sum += x[i];
    float mean = dot(sum, vec4(1.0 / 32.0));
    [[unroll]] for (uint i = 0u; i < WIDTH4; i++) squares += (x[i] - mean) * (x[i] - mean);
    return vec2(mean, inversesqrt(dot(squares, vec4(1.0 / 32.0)) + MIN_VARIANCE));
}
