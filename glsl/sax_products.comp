#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// What tiles of samples say of the Lineformer's numbers: products of vectors that samples left, added up in the samples'
// order, to what the tiles of dispatches before said. One workgroup per tile (x) and product (y).
//   sax_weight_parts[place of the tile][number / 4]
#include "inc/sax_layout.glsl"
#include "inc/lineformer_layout.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_tile; } push;
layout(binding = 0) readonly buffer B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { SaxProduct sax_products[]; };
layout(binding = 2) readonly buffer B2 { vec4 sax_tile_vectors[]; };
layout(binding = 3) buffer B3 { vec4 sax_weight_parts[]; };
#include "inc/sax_tiles.glsl"

void keep(uint at, vec4 sum) {
    uint place = gl_WorkGroupID.x * (sax_setup.n_weights / 4u) + at;
    sax_weight_parts[place] = push.first_tile == 0u ? sum : sax_weight_parts[place] + sum;
}

// Four rows and two columns, in vec4, of a product.
void add_product(SaxProduct product) {
    uint lane = gl_LocalInvocationID.x, column = 2u * (lane % 4u);
    uint left = vector_place(gl_WorkGroupID.x, product.left) + lane / 4u;
    uint right = vector_place(gl_WorkGroupID.x, product.right) + column;
    mat4 sum0 = mat4(0.0), sum1 = mat4(0.0);
    [[dont_unroll]] for (uint s = 0u; s < TILE_SAMPLES; s++) {
        vec4 factors = sax_tile_vectors[left + s * 8u];
        sum0 += outerProduct(sax_tile_vectors[right + s * 8u], factors);
        sum1 += outerProduct(sax_tile_vectors[right + s * 8u + 1u], factors);
    }
    uint place = product.first + lane / 4u * 4u * product.stride + column;
    [[dont_unroll]] for (uint row = 0u; row < 4u; row++) {
        if (column < product.columns) keep(place + row * product.stride, sum0[row]);
        if (column + 1u < product.columns) keep(place + row * product.stride + 1u, sum1[row]);
    }
}

// The sum of a vector.
void add_vector(SaxProduct product) {
    uint lane = gl_LocalInvocationID.x;
    if (lane >= 8u) return;
    vec4 sum = vec4(0.0);
    [[dont_unroll]] for (uint s = 0u; s < TILE_SAMPLES; s++)
        sum += sax_tile_vectors[vector_place(gl_WorkGroupID.x, product.left) + s * 8u + lane];
    keep(product.first + lane, sum);
}

void main() {
    SaxProduct product = sax_products[gl_WorkGroupID.y];
    if (product.columns > 0u) {
        add_product(product);
    } else {
        add_vector(product);
    }
}
