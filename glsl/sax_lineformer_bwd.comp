#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Gradients by samples' features from those of line integrals, back through the Lineformer, and the vectors that gradients
// of its own numbers are products of. One invocation per pair of samples, which computes activations anew rather than
// keeping them from the forward pass; one workgroup per tile of 32 pairs.
//   sax_tile_vectors[tile of this dispatch][vector][sample of the tile][number / 4]
//   sax_encoding_gradient[pair of levels][sample]
#include "inc/sax_layout.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_tile; } push;
layout(binding = 0) readonly buffer B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { vec4 sax_params[]; };
layout(binding = 2) readonly buffer B2 { vec4 sax_points[]; };
layout(binding = 3) readonly buffer B3 { vec4 sax_encoding[]; };
layout(binding = 4) readonly buffer B4 { float sax_ray_gradient[]; };
layout(binding = 5) readonly buffer B5 { SaxStep sax_steps[]; };
layout(binding = 6) writeonly buffer B6 { vec4 sax_tile_vectors[]; };
layout(binding = 7) writeonly buffer B7 { vec4 sax_encoding_gradient[]; };
#include "inc/lineformer.glsl"
#include "inc/sax_tiles.glsl"

// Leaves the pair's vectors.
void leave_vectors() {
    [[dont_unroll]] for (uint i = 0u; i < SAX_VECTORS * 2u * WIDTH4; i++) {
        uint vector = i / (2u * WIDTH4), rest = i % (2u * WIDTH4);
        sax_tile_vectors[vector_place(gl_WorkGroupID.x, vector) + 2u * gl_LocalInvocationID.x * WIDTH4 + rest] =
            vectors[i];
    }
}

// Adds W^T d of 32 rows.
void times_back(SaxStep now) {
    uint to = at(now.to), from = at(now.from);
    [[dont_unroll]] for (uint i = 0u; i < now.columns; i++) {
        vec4 a = vec4(0.0), b = vec4(0.0);
        [[dont_unroll]] for (uint o = 0u; o < WIDTH4; o++) {
            uint place = now.first + 4u * o * now.stride + i;
            mat4 rows = mat4(sax_params[place], sax_params[place + now.stride], sax_params[place + 2u * now.stride],
                             sax_params[place + 3u * now.stride]);
            a += rows * vectors[from + o];
            b += rows * vectors[from + WIDTH4 + o];
        }
        vectors[to + i] += a;
        vectors[to + WIDTH4 + i] += b;
    }
}

void norm_back(SaxStep now) {
    [[dont_unroll]] for (uint s = 0u; s < 2u; s++) {
        uint to = at(now.to) + s * WIDTH4, from = at(now.from) + s * WIDTH4;
        uint by = at(SAX_BY_NORMAL) + s * WIDTH4;
        uint by_scale = at(now.columns) + s * WIDTH4, by_shift = at(now.columns + 1u) + s * WIDTH4;
        vec2 moments = moments_of(from);
        vec4 sum = vec4(0.0), along = vec4(0.0);
        [[dont_unroll]] for (uint i = 0u; i < WIDTH4; i++) {
            vec4 hat = (vectors[from + i] - moments.x) * moments.y, d = vectors[by + i];
            vectors[by_scale + i] = d * hat;
            vectors[by_shift + i] = d;
            d *= sax_params[now.first + i];
            vectors[by + i] = d;
            sum += d;
            along += d * hat;
        }
        float mean = dot(sum, vec4(1.0 / 32.0)), share = dot(along, vec4(1.0 / 32.0));
        [[dont_unroll]] for (uint i = 0u; i < WIDTH4; i++) {
            vec4 hat = (vectors[from + i] - moments.x) * moments.y;
            vectors[to + i] += moments.y * (vectors[by + i] - mean - share * hat);
        }
    }
}

void attend_back() {
    [[dont_unroll]] for (uint head = 0u; head < WIDTH4; head++) {
        uint other = WIDTH4 + head;
        vec4 a = vectors[at(SAX_BY_SEEN) + head], b = vectors[at(SAX_BY_SEEN) + other], shares = shares_of(head);
        vectors[at(SAX_BY_VALUE) + head] = shares.x * a + shares.z * b;
        vectors[at(SAX_BY_VALUE) + other] = shares.y * a + shares.w * b;
        // What a share of the one is worth more than of the other.
        vec4 apart = vectors[at(SAX_VALUE) + head] - vectors[at(SAX_VALUE) + other];
        vec2 by_like = shares.xz * shares.yw * vec2(dot(a, apart), dot(b, apart));
        vectors[at(SAX_POSITION) + head] = vec4(by_like.x, -by_like.x, by_like.y, -by_like.y);
        vec4 keys_apart = vectors[at(SAX_KEY) + head] - vectors[at(SAX_KEY) + other];
        vectors[at(SAX_BY_QUERY) + head] = 0.5 * by_like.x * keys_apart;
        vectors[at(SAX_BY_QUERY) + other] = 0.5 * by_like.y * keys_apart;
        vec4 by_key = 0.5 * (by_like.x * vectors[at(SAX_QUERY) + head] + by_like.y * vectors[at(SAX_QUERY) + other]);
        vectors[at(SAX_BY_KEY) + head] = by_key;
        vectors[at(SAX_BY_KEY) + other] = -by_key;
    }
}

// Gradient by the last layer's result, from that by both densities.
void density_back(vec2 by_sigma) {
    vec2 sigma = density();
    vec2 d = by_sigma * sigma * (1.0 - sigma);
    [[dont_unroll]] for (uint i = 0u; i < WIDTH4; i++) {
        vec4 weight = sax_params[LINEFORMER_DENSITY + i];
        vectors[at(SAX_DENSITY) + i] = d.x * vectors[at(SAX_X3) + i] + d.y * vectors[at(SAX_X3) + WIDTH4 + i];
        vectors[at(SAX_BY_JOINT) + i] = d.x * weight;
        vectors[at(SAX_BY_JOINT) + WIDTH4 + i] = d.y * weight;
    }
    vectors[at(SAX_DENSITY + 1u)].x = d.x + d.y;
}

void take_back(SaxStep now, vec2 by_sigma) {
    if (now.kind == SAX_BACK) {
        times_back(now);
    } else if (now.kind == SAX_BACK_NORM) {
        norm_back(now);
    } else if (now.kind == SAX_BACK_ATTEND) {
        attend_back();
    } else if (now.kind == SAX_BACK_DENSITY) {
        density_back(by_sigma);
    } else {
        take_forward(now);
    }
}

void main() {
    uint n_samples = sax_setup.n_rays * sax_setup.n_samples;
    uint s = (push.first_tile + gl_WorkGroupID.x) * TILE_SAMPLES + 2u * gl_LocalInvocationID.x;
    // Of lanes without a pair gradients are zero, and so is what they add.
    bool is_pair = s < n_samples;
    vec2 by_sigma = vec2(0.0);
    clear_vectors();
    if (is_pair) {
        [[dont_unroll]] for (uint i = 0u; i < input4(); i++) {
            vectors[at(SAX_FEATURES) + i] = sax_encoding[i * n_samples + s];
            vectors[at(SAX_FEATURES) + WIDTH4 + i] = sax_encoding[i * n_samples + s + 1u];
        }
        by_sigma = sax_ray_gradient[s / sax_setup.n_samples] * vec2(sax_points[s].w, sax_points[s + 1u].w);
    }
    [[dont_unroll]] for (uint k = 0u; k < sax_setup.n_steps; k++) take_back(sax_steps[k], by_sigma);
    leave_vectors();
    [[dont_unroll]] for (uint i = 0u; is_pair && i < input4(); i++) {
        sax_encoding_gradient[i * n_samples + s] = vectors[at(SAX_BY_FEATURES) + i];
        sax_encoding_gradient[i * n_samples + s + 1u] = vectors[at(SAX_BY_FEATURES) + WIDTH4 + i];
    }
}
