#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Gradients of the Lineformer from those of line integrals: by samples' features, and by its own numbers. One invocation
// per pair of samples, which computes activations anew rather than keeping them from the forward pass. A workgroup walks
// over tiles of 32 pairs. Lanes leave in a place of the workgroup's own what the numbers' gradients are products of; then
// each has a row of each product, which it adds up over the tile's samples in their order.
//   sax_weight_parts[workgroup][number / 4], sax_tile_vectors[workgroup][vector][sample of the tile][number / 4],
//   sax_encoding_gradient[pair of levels][sample]
#include "inc/sax_layout.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(binding = 0) readonly buffer B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { vec4 sax_params[]; };
layout(binding = 2) readonly buffer B2 { vec4 sax_points[]; };
layout(binding = 3) readonly buffer B3 { vec4 sax_encoding[]; };
layout(binding = 4) readonly buffer B4 { float sax_ray_gradient[]; };
layout(binding = 5) readonly buffer B5 { SaxProduct sax_products[]; };
layout(binding = 6) coherent buffer B6 { vec4 sax_tile_vectors[]; };
layout(binding = 7) buffer B7 { vec4 sax_weight_parts[]; };
layout(binding = 8) writeonly buffer B8 { vec4 sax_encoding_gradient[]; };
#include "inc/lineformer.glsl"

const uint LANES = 32u;         // as many as a vector has numbers
const uint SAMPLES = 64u;       // of a tile

uint vector_place(uint vector) {
    return (gl_WorkGroupID.x * SAX_VECTORS + vector) * SAMPLES * WIDTH4;
}

// Leaves a vector of each of the pair's samples to the workgroup.
void leave(uint vector, Pair x) {
    uint place = vector_place(vector) + 2u * gl_LocalInvocationID.x * WIDTH4;
    for (uint i = 0u; i < WIDTH4; i++) {
        sax_tile_vectors[place + i] = x.a[i];
        sax_tile_vectors[place + WIDTH4 + i] = x.b[i];
    }
}

void leave(uint vector, vec4 of_pair[8]) {
    leave(vector, Pair(of_pair, nothing().b));
}

// Adds the tile's sum to that of the tiles before it.
void keep(uint at, vec4 sum, bool first_tile) {
    uint place = gl_WorkGroupID.x * (sax_setup.n_weights / 4u) + at;
    sax_weight_parts[place] = first_tile ? sum : sax_weight_parts[place] + sum;
}

// A row of the sum of left x right over the tile's samples.
void add_product(SaxProduct product, bool first_tile) {
    uint lane = gl_LocalInvocationID.x;
    uint left = vector_place(product.left) + lane / 4u, right = vector_place(product.right);
    vec4 sum[8] = nothing().a;
    [[dont_unroll]] for (uint s = 0u; s < SAMPLES; s++) {
        float factor = sax_tile_vectors[left + s * WIDTH4][lane % 4u];
        [[unroll]] for (uint i = 0u; i < WIDTH4; i++) sum[i] += factor * sax_tile_vectors[right + s * WIDTH4 + i];
    }
    [[unroll]] for (uint i = 0u; i < WIDTH4; i++)
        if (i < product.columns) keep(product.first + lane * product.stride + i, sum[i], first_tile);
}

// The sum of a vector over the tile's samples.
void add_vector(SaxProduct product, bool first_tile) {
    uint lane = gl_LocalInvocationID.x;
    if (lane >= WIDTH4) return;
    vec4 sum = vec4(0.0);
    [[dont_unroll]] for (uint s = 0u; s < SAMPLES; s++)
        sum += sax_tile_vectors[vector_place(product.left) + s * WIDTH4 + lane];
    keep(product.first + lane, sum, first_tile);
}

void add_tile(bool first_tile) {
    [[dont_unroll]] for (uint k = 0u; k < SAX_PRODUCTS; k++) {
        SaxProduct product = sax_products[k];
        if (product.columns > 0u) {
            add_product(product, first_tile);
        } else {
            add_vector(product, first_tile);
        }
    }
}

// Through the activation whose result is `y`, which has its argument's sign.
Pair through_leaky(Pair d, Pair y) {
    for (uint i = 0u; i < WIDTH4; i++) {
        d.a[i] *= mix(vec4(LEAK), vec4(1.0), greaterThan(y.a[i], vec4(0.0)));
        d.b[i] *= mix(vec4(LEAK), vec4(1.0), greaterThan(y.b[i], vec4(0.0)));
    }
    return d;
}

Pair through_gelu(Pair d, Pair x) {
    for (uint i = 0u; i < WIDTH4; i++) {
        d.a[i] *= gelu_slope(x.a[i]);
        d.b[i] *= gelu_slope(x.b[i]);
    }
    return d;
}

vec4[8] through_norm(vec4 d[8], vec4 hat[8], float inverse) {
    float along = 0.0, mean = sum_of(d) / 32.0;
    for (uint i = 0u; i < WIDTH4; i++) along += dot(d[i], hat[i]);
    along /= 32.0;
    for (uint i = 0u; i < WIDTH4; i++) d[i] = inverse * (d[i] - mean - along * hat[i]);
    return d;
}

// Through the normalisation whose numbers begin at `first`; what it says of these is left as `vector` and the next.
Pair through_norm(uint first, uint vector, Pair d, Pair hat, vec2 inverse) {
    Pair by_scale;
    for (uint i = 0u; i < WIDTH4; i++) {
        by_scale.a[i] = d.a[i] * hat.a[i];
        by_scale.b[i] = d.b[i] * hat.b[i];
    }
    leave(vector, by_scale);
    leave(vector + 1u, d);
    for (uint i = 0u; i < WIDTH4; i++) {
        d.a[i] *= sax_params[first + i];
        d.b[i] *= sax_params[first + i];
    }
    d.a = through_norm(d.a, hat.a, inverse.x);
    d.b = through_norm(d.b, hat.b, inverse.y);
    return d;
}

// Through the attention, from the gradient by what its samples saw.
Pair through_attention(Pair d, Attention at) {
    Pair query, key, value;
    vec4 by_position[8];
    for (uint head = 0u; head < WIDTH4; head++) {
        vec4 a = d.a[head], b = d.b[head], shares = at.shares[head];
        value.a[head] = shares.x * a + shares.z * b;
        value.b[head] = shares.y * a + shares.w * b;
        // What a share of the one is worth more than of the other.
        vec4 apart = at.value.a[head] - at.value.b[head];
        vec2 by_like = shares.xz * shares.yw * vec2(dot(a, apart), dot(b, apart));
        by_position[head] = vec4(by_like.x, -by_like.x, by_like.y, -by_like.y);
        vec4 keys_apart = at.key.a[head] - at.key.b[head];
        // The queries were halved.
        query.a[head] = 0.5 * by_like.x * keys_apart;
        query.b[head] = 0.5 * by_like.y * keys_apart;
        key.a[head] = by_like.x * at.query.a[head] + by_like.y * at.query.b[head];
        key.b[head] = -key.a[head];
    }
    leave(SAX_POSITION, by_position);
    leave(SAX_BY_QUERY, query);
    leave(SAX_BY_KEY, key);
    leave(SAX_BY_VALUE, value);
    Pair sum = times_transposed(LINEFORMER_QUERY, WIDTH4, WIDTH4, query);
    sum = plus(sum, times_transposed(LINEFORMER_KEY, WIDTH4, WIDTH4, key));
    return plus(sum, times_transposed(LINEFORMER_VALUE, WIDTH4, WIDTH4, value));
}

// Through the feed-forward part on `x`, whose second layer before its GELU is `second`.
Pair through_feed_forward(Pair d, Pair x, Pair second[4]) {
    [[dont_unroll]] for (uint slice = 0u; slice < FFN_SLICES; slice++) {
        leave(SAX_SECOND + slice, gelu(second[slice]));
        Pair back = times_transposed(contract_at(slice), FFN_STRIDE, WIDTH4, d);
        second[slice] = through_gelu(back, second[slice]);
        leave(SAX_BY_SECOND + slice, second[slice]);
    }
    Pair sum = nothing();
    [[dont_unroll]] for (uint from = 0u; from < FFN_SLICES; from++) {
        Pair back = nothing();
        [[dont_unroll]] for (uint to = 0u; to < FFN_SLICES; to++)
            back = plus(back, times_transposed(mix_at(to, from), FFN_STRIDE, WIDTH4, second[to]));
        back = through_gelu(back, expanded(from, x));
        leave(SAX_BY_FIRST + from, back);
        sum = plus(sum, times_transposed(LINEFORMER_EXPAND + from * 256u, WIDTH4, WIDTH4, back));
    }
    return sum;
}

// Gradient by the last layer's result, from that by both densities.
Pair through_density(Pair x, vec2 by_sigma) {
    vec2 sigma = density(x);
    vec2 d = by_sigma * sigma * (1.0 - sigma);
    vec4 by_weight[8], by_bias[8];
    Pair back;
    for (uint i = 0u; i < WIDTH4; i++) {
        by_weight[i] = d.x * x.a[i] + d.y * x.b[i];
        by_bias[i] = vec4(0.0);
        back.a[i] = d.x * sax_params[LINEFORMER_DENSITY + i];
        back.b[i] = d.y * sax_params[LINEFORMER_DENSITY + i];
    }
    by_bias[0].x = d.x + d.y;
    leave(SAX_DENSITY, by_weight);
    leave(SAX_DENSITY + 1u, by_bias);
    return back;
}

// Gradient by the features of a pair, from that by its densities.
Pair through_pair(Pair encoding, vec2 by_sigma) {
    vec2 inverse1, inverse2;
    Pair x1 = plus(vector_at(LINEFORMER_INPUT_BIAS), times(LINEFORMER_INPUT, input4(), input4(), encoding));
    x1 = leaky(x1);
    Pair hat1 = normalised(x1, inverse1);
    Pair normal1 = affine(LINEFORMER_NORM1, hat1);
    Attention at = attend(normal1);
    Pair y = plus(x1, plus(vector_at(LINEFORMER_OUT + 256u), times(LINEFORMER_OUT, WIDTH4, WIDTH4, at.seen)));
    Pair hat2 = normalised(y, inverse2);
    Pair normal2 = affine(LINEFORMER_NORM2, hat2);
    Pair first[4], second[4];
    [[dont_unroll]] for (uint slice = 0u; slice < FFN_SLICES; slice++) {
        first[slice] = gelu(expanded(slice, normal2));
        leave(SAX_FIRST + slice, first[slice]);
    }
    Pair x2 = y;
    [[dont_unroll]] for (uint slice = 0u; slice < FFN_SLICES; slice++) {
        second[slice] = mixed(slice, first);
        x2 = plus(x2, times(contract_at(slice), FFN_STRIDE, WIDTH4, gelu(second[slice])));
    }
    x2 = leaky(x2);
    Pair x3 = leaky(joined(encoding, x2));

    leave(SAX_FEATURES, encoding);
    leave(SAX_NORMAL1, normal1);
    leave(SAX_SEEN, at.seen);
    leave(SAX_NORMAL2, normal2);
    leave(SAX_BLOCK, x2);
    Pair d = through_leaky(through_density(x3, by_sigma), x3);
    leave(SAX_BY_JOINT, d);
    Pair by_encoding = times_transposed(joint_at(), joint_stride(), input4(), d);
    d = through_leaky(times_transposed(joint_at() + input4(), joint_stride(), WIDTH4, d), x2);
    leave(SAX_BY_BLOCK, d);
    Pair back = through_feed_forward(d, normal2, second);
    d = plus(d, through_norm(LINEFORMER_NORM2, SAX_NORM2, back, hat2, inverse2));
    leave(SAX_BY_OUT, d);
    back = through_attention(times_transposed(LINEFORMER_OUT, WIDTH4, WIDTH4, d), at);
    d = plus(d, through_norm(LINEFORMER_NORM1, SAX_NORM1, back, hat1, inverse1));
    d = through_leaky(d, x1);
    leave(SAX_BY_INPUT, d);
    return plus(by_encoding, times_transposed(LINEFORMER_INPUT, input4(), input4(), d));
}

void main() {
    uint n_samples = sax_setup.n_rays * sax_setup.n_samples, n_pairs = n_samples / 2u;
    uint n_tiles = (n_pairs + LANES - 1u) / LANES;
    for (uint tile = gl_WorkGroupID.x; tile < n_tiles; tile += sax_setup.n_groups) {
        uint s = 2u * (tile * LANES + gl_LocalInvocationID.x);
        // Of lanes without a pair gradients are zero, and so is what they add.
        bool is_pair = s < n_samples;
        Pair encoding = nothing();
        vec2 by_sigma = vec2(0.0);
        if (is_pair) {
            for (uint i = 0u; i < input4(); i++) {
                encoding.a[i] = sax_encoding[i * n_samples + s];
                encoding.b[i] = sax_encoding[i * n_samples + s + 1u];
            }
            by_sigma = sax_ray_gradient[s / sax_setup.n_samples] * vec2(sax_points[s].w, sax_points[s + 1u].w);
        }
        Pair gradient = through_pair(encoding, by_sigma);
        for (uint i = 0u; is_pair && i < input4(); i++) {
            sax_encoding_gradient[i * n_samples + s] = gradient.a[i];
            sax_encoding_gradient[i * n_samples + s + 1u] = gradient.b[i];
        }
        memoryBarrierBuffer();
        barrier();
        add_tile(tile == gl_WorkGroupID.x);
        barrier();
    }
}
