// The Lineformer of SAX-NeRF on a pair of neighbouring samples, step by step (`sax/program.rs` has the steps): compilers see
// each kind of step once, and not a matrix for each layer, which those of CPUs take minutes over. Needs `sax_setup`,
// `SaxStep sax_steps[]` and `vec4 sax_params[]`.
#include "inc/lineformer_layout.glsl"

const float LEAK = 0.01;
const float LEAST_VARIANCE = 1e-5;
const uint WIDTH4 = 8u;         // 32 numbers

// 32 numbers of the first sample, then of the second, for each vector.
vec4 vectors[SAX_ALL_VECTORS * 2u * WIDTH4];

uint input4() { return sax_setup.n_levels / 2u; }

// Where a vector is.
uint at(uint vector) { return vector * 2u * WIDTH4; }

void clear_vectors() {
    [[dont_unroll]] for (uint i = 0u; i < SAX_ALL_VECTORS * 2u * WIDTH4; i++) vectors[i] = vec4(0.0);
}

// Adds W x of 32 rows.
void times(SaxStep now) {
    uint to = at(now.to), from = at(now.from);
    [[dont_unroll]] for (uint o = 0u; o < WIDTH4; o++) {
        vec4 a = vec4(0.0), b = vec4(0.0);
        [[dont_unroll]] for (uint i = 0u; i < now.columns; i++) {
            uint place = now.first + 4u * o * now.stride + i;
            mat4 rows = mat4(sax_params[place], sax_params[place + now.stride], sax_params[place + 2u * now.stride],
                             sax_params[place + 3u * now.stride]);
            a += vectors[from + i] * rows;
            b += vectors[from + WIDTH4 + i] * rows;
        }
        vectors[to + o] += a;
        vectors[to + WIDTH4 + o] += b;
    }
}

vec4 leaky(vec4 x) { return max(x, LEAK * x); }

// Share of a standard normal below x (Abramowitz and Stegun 7.1.26, off by 8e-8 at most).
vec4 normal_share(vec4 x) {
    vec4 t = 1.0 / (1.0 + 0.2316418882663604 * abs(x));
    vec4 tail = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    tail *= 0.5 * exp(-0.5 * x * x);
    return mix(tail, 1.0 - tail, greaterThanEqual(x, vec4(0.0)));
}

// Mean of a sample's numbers at `place`, and the inverse of their standard deviation.
vec2 moments_of(uint place) {
    vec4 sum = vec4(0.0), squares = vec4(0.0);
    [[dont_unroll]] for (uint i = 0u; i < WIDTH4; i++) sum += vectors[place + i];
    float mean = dot(sum, vec4(1.0 / 32.0));
    [[dont_unroll]] for (uint i = 0u; i < WIDTH4; i++) squares += (vectors[place + i] - mean) * (vectors[place + i] - mean);
    return vec2(mean, inversesqrt(dot(squares, vec4(1.0 / 32.0)) + LEAST_VARIANCE));
}

void normalise(SaxStep now) {
    [[dont_unroll]] for (uint s = 0u; s < 2u; s++) {
        uint to = at(now.to) + s * WIDTH4, from = at(now.from) + s * WIDTH4;
        vec2 moments = moments_of(from);
        [[dont_unroll]] for (uint i = 0u; i < WIDTH4; i++) {
            vec4 hat = (vectors[from + i] - moments.x) * moments.y;
            vectors[to + i] = sax_params[now.first + i] * hat + sax_params[now.first + WIDTH4 + i];
        }
    }
}

// Shares of a head: a of a, b of a, a of b, b of b. Of two, the softmax is a sigmoid of their difference; queries are halved,
// by the root of a head's size.
vec4 shares_of(uint head) {
    vec4 qa = vectors[at(SAX_QUERY) + head], qb = vectors[at(SAX_QUERY) + WIDTH4 + head];
    vec4 ka = vectors[at(SAX_KEY) + head], kb = vectors[at(SAX_KEY) + WIDTH4 + head];
    vec4 like = 0.5 * vec4(dot(qa, ka), dot(qa, kb), dot(qb, ka), dot(qb, kb)) + sax_params[LINEFORMER_POSITION + head];
    vec2 own = 1.0 / (1.0 + exp(like.yw - like.xz));
    return vec4(own.x, 1.0 - own.x, own.y, 1.0 - own.y);
}

void attend() {
    [[dont_unroll]] for (uint head = 0u; head < WIDTH4; head++) {
        vec4 shares = shares_of(head);
        vec4 a = vectors[at(SAX_VALUE) + head], b = vectors[at(SAX_VALUE) + WIDTH4 + head];
        vectors[at(SAX_SEEN) + head] = shares.x * a + shares.y * b;
        vectors[at(SAX_SEEN) + WIDTH4 + head] = shares.z * a + shares.w * b;
    }
}

void change_each(SaxStep now) {
    [[dont_unroll]] for (uint i = 0u; i < 2u * WIDTH4; i++) {
        vec4 to = vectors[at(now.to) + i], from = vectors[at(now.from) + i];
        if (now.kind == SAX_SET) to = sax_params[now.first + i % WIDTH4];
        if (now.kind == SAX_CLEAR) to = vec4(0.0);
        if (now.kind == SAX_ADD) to += from;
        if (now.kind == SAX_LEAKY) to = leaky(to);
        if (now.kind == SAX_GELU) to = from * normal_share(from);
        // The result has its argument's sign.
        if (now.kind == SAX_BACK_LEAKY) to *= mix(vec4(LEAK), vec4(1.0), greaterThan(from, vec4(0.0)));
        if (now.kind == SAX_BACK_GELU) to *= normal_share(from) + from * 0.3989422804014327 * exp(-0.5 * from * from);
        vectors[at(now.to) + i] = to;
    }
}

void take_forward(SaxStep now) {
    if (now.kind == SAX_TIMES) {
        times(now);
    } else if (now.kind == SAX_NORM) {
        normalise(now);
    } else if (now.kind == SAX_ATTEND) {
        attend();
    } else {
        change_each(now);
    }
}

// Densities of both samples.
vec2 density() {
    vec2 sum = vec2(sax_params[LINEFORMER_DENSITY + WIDTH4].x);
    [[dont_unroll]] for (uint i = 0u; i < WIDTH4; i++) {
        vec4 weight = sax_params[LINEFORMER_DENSITY + i];
        sum += vec2(dot(weight, vectors[at(SAX_X3) + i]), dot(weight, vectors[at(SAX_X3) + WIDTH4 + i]));
    }
    return 1.0 / (1.0 + exp(-sum));
}
