// The Lineformer of SAX-NeRF on a pair of neighbouring samples: a layer, one attention block in which the two see each
// other, a layer on its result beside the input, and a density. Needs `sax_setup` and `vec4 sax_params[]`.
// Loops over rows and slices stay loops: unrolled, each matrix would be thousands of instructions, which drivers compile
// for minutes. Those over a row's columns are unrolled, so that numbers are found without counting.
#include "inc/lineformer_layout.glsl"

// 32 numbers of each of the two samples.
struct Pair {
    vec4 a[8];
    vec4 b[8];
};

// What both passes compute alike.
struct Attention {
    Pair query;                 // times 1/2, the root of a head's size
    Pair key;
    Pair value;
    vec4 shares[8];             // of each head: a of a, b of a, a of b, b of b
    Pair seen;                  // values by their shares
};

const float LEAK = 0.01;
const float LEAST_VARIANCE = 1e-5;
const uint WIDTH4 = 8u;         // 32 numbers
const uint FFN_SLICES = 4u;     // 128 numbers

uint input4() { return sax_setup.n_levels / 2u; }
uint joint_stride() { return input4() + WIDTH4; }
uint joint_at() { return LINEFORMER_INPUT + 4u * WIDTH4 * input4(); }

Pair nothing() {
    Pair x;
    for (uint i = 0u; i < WIDTH4; i++) {
        x.a[i] = vec4(0.0);
        x.b[i] = vec4(0.0);
    }
    return x;
}

Pair plus(Pair x, Pair y) {
    for (uint i = 0u; i < WIDTH4; i++) {
        x.a[i] += y.a[i];
        x.b[i] += y.b[i];
    }
    return x;
}

Pair scaled(Pair x, float by) {
    for (uint i = 0u; i < WIDTH4; i++) {
        x.a[i] *= by;
        x.b[i] *= by;
    }
    return x;
}

// Numbers from `first` on, for both samples.
Pair vector_at(uint first) {
    Pair x;
    for (uint i = 0u; i < WIDTH4; i++) {
        x.a[i] = sax_params[first + i];
        x.b[i] = x.a[i];
    }
    return x;
}

// Four rows of a matrix, at a column.
mat4 rows_at(uint first, uint stride) {
    return mat4(sax_params[first], sax_params[first + stride], sax_params[first + 2u * stride],
                sax_params[first + 3u * stride]);
}

// W x of 32 rows that begin at `first`, `stride` apart, and `n` columns; all of these in vec4.
Pair times(uint first, uint stride, uint n, Pair x) {
    Pair y;
    [[dont_unroll]] for (uint o = 0u; o < WIDTH4; o++) {
        vec4 a = vec4(0.0), b = vec4(0.0);
        [[unroll]] for (uint i = 0u; i < WIDTH4; i++) {
            if (i >= n) continue;
            mat4 rows = rows_at(first + 4u * o * stride + i, stride);
            a += x.a[i] * rows;
            b += x.b[i] * rows;
        }
        y.a[o] = a;
        y.b[o] = b;
    }
    return y;
}

// W^T d of the same.
Pair times_transposed(uint first, uint stride, uint n, Pair d) {
    Pair y = nothing();
    [[dont_unroll]] for (uint i = 0u; i < n; i++) {
        vec4 a = vec4(0.0), b = vec4(0.0);
        [[unroll]] for (uint o = 0u; o < WIDTH4; o++) {
            mat4 rows = rows_at(first + 4u * o * stride + i, stride);
            a += rows * d.a[o];
            b += rows * d.b[o];
        }
        y.a[i] = a;
        y.b[i] = b;
    }
    return y;
}

vec4 leaky(vec4 x) { return max(x, LEAK * x); }

Pair leaky(Pair x) {
    for (uint i = 0u; i < WIDTH4; i++) {
        x.a[i] = leaky(x.a[i]);
        x.b[i] = leaky(x.b[i]);
    }
    return x;
}

// Share of a standard normal below x (Abramowitz and Stegun 7.1.26, off by 8e-8 at most).
vec4 normal_share(vec4 x) {
    vec4 t = 1.0 / (1.0 + 0.2316418882663604 * abs(x));
    vec4 tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    tail *= 0.5 * exp(-0.5 * x * x);
    return mix(tail, 1.0 - tail, greaterThanEqual(x, vec4(0.0)));
}

vec4 gelu(vec4 x) { return x * normal_share(x); }

vec4 gelu_slope(vec4 x) { return normal_share(x) + x * 0.3989422804014327 * exp(-0.5 * x * x); }

Pair gelu(Pair x) {
    for (uint i = 0u; i < WIDTH4; i++) {
        x.a[i] = gelu(x.a[i]);
        x.b[i] = gelu(x.b[i]);
    }
    return x;
}

float sum_of(vec4 x[8]) {
    vec4 sum = vec4(0.0);
    for (uint i = 0u; i < WIDTH4; i++) sum += x[i];
    return dot(sum, vec4(1.0));
}

// Less the mean, over the standard deviation, whose inverse is `inverse`.
vec4[8] normalised(vec4 x[8], out float inverse) {
    float mean = sum_of(x) / 32.0;
    float variance = 0.0;
    for (uint i = 0u; i < WIDTH4; i++) {
        x[i] -= mean;
        variance += dot(x[i], x[i]);
    }
    inverse = inversesqrt(variance / 32.0 + LEAST_VARIANCE);
    for (uint i = 0u; i < WIDTH4; i++) x[i] *= inverse;
    return x;
}

Pair normalised(Pair x, out vec2 inverse) {
    x.a = normalised(x.a, inverse.x);
    x.b = normalised(x.b, inverse.y);
    return x;
}

// Scales and shifts of a normalisation, which begin at `first`.
Pair affine(uint first, Pair x) {
    for (uint i = 0u; i < WIDTH4; i++) {
        vec4 scale = sax_params[first + i], shift = sax_params[first + WIDTH4 + i];
        x.a[i] = scale * x.a[i] + shift;
        x.b[i] = scale * x.b[i] + shift;
    }
    return x;
}

Attention attend(Pair x) {
    Attention at;
    at.query = scaled(times(LINEFORMER_QUERY, WIDTH4, WIDTH4, x), 0.5);
    at.key = times(LINEFORMER_KEY, WIDTH4, WIDTH4, x);
    at.value = times(LINEFORMER_VALUE, WIDTH4, WIDTH4, x);
    for (uint head = 0u; head < WIDTH4; head++) {
        vec4 like = vec4(dot(at.query.a[head], at.key.a[head]), dot(at.query.a[head], at.key.b[head]),
                         dot(at.query.b[head], at.key.a[head]), dot(at.query.b[head], at.key.b[head]));
        like += sax_params[LINEFORMER_POSITION + head];
        // Of two, the softmax is a sigmoid of their difference.
        vec2 own = 1.0 / (1.0 + exp(like.yw - like.xz));
        at.shares[head] = vec4(own.x, 1.0 - own.x, own.y, 1.0 - own.y);
        at.seen.a[head] = own.x * at.value.a[head] + (1.0 - own.x) * at.value.b[head];
        at.seen.b[head] = own.y * at.value.a[head] + (1.0 - own.y) * at.value.b[head];
    }
    return at;
}

Pair expanded(uint slice, Pair x) { return times(LINEFORMER_EXPAND + slice * 256u, WIDTH4, WIDTH4, x); }

uint mix_at(uint to, uint from) { return LINEFORMER_MIX + to * 1024u + from * WIDTH4; }

uint contract_at(uint slice) { return LINEFORMER_CONTRACT + slice * WIDTH4; }

// Rows of 128 inputs.
const uint FFN_STRIDE = 32u;

// The second layer of the feed-forward part before its GELU, 32 numbers of it, from the first after it.
Pair mixed(uint to, Pair first[4]) {
    Pair sum = nothing();
    [[dont_unroll]] for (uint from = 0u; from < FFN_SLICES; from++)
        sum = plus(sum, times(mix_at(to, from), FFN_STRIDE, WIDTH4, first[from]));
    return sum;
}

// The layer on the block's result beside the input, before its activation.
Pair joined(Pair encoding, Pair x) {
    Pair y = plus(vector_at(LINEFORMER_JOINT_BIAS), times(joint_at(), joint_stride(), input4(), encoding));
    return plus(y, times(joint_at() + input4(), joint_stride(), WIDTH4, x));
}

// Densities of both samples.
vec2 density(Pair x) {
    vec2 sum = vec2(sax_params[LINEFORMER_DENSITY + WIDTH4].x);
    for (uint i = 0u; i < WIDTH4; i++) {
        vec4 weight = sax_params[LINEFORMER_DENSITY + i];
        sum += vec2(dot(weight, x.a[i]), dot(weight, x.b[i]));
    }
    return 1.0 / (1.0 + exp(-sum));
}
