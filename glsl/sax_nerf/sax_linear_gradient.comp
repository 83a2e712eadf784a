#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Weight gradients of the Lineformer from a chunk of samples: products of two of the samples' vectors, summed in the order of
// the samples and added to the sums of earlier chunks. A lane processes INPUTS columns of a product at once with all of their
// rows; the loads of the rows are uniform. One workgroup per part of the samples (x) and product (y).
//   sax_weight_parts[part][number]
#include "inc/operands.glsl"
#include "inc/sax_layout.glsl"
#ifndef INPUTS
#define INPUTS 2u
#endif
layout(local_size_x = 16, local_size_x_id = 0) in;
// `first_feature` and `feature_stride` are those of `sax_linear`; `part_samples` is the number of samples of a part.
layout(push_constant) uniform Push {
    uint n_samples; uint capacity; uint first_feature; uint feature_stride; uint part_samples; uint adds;
} push;
READ_VEC4(0, B0, sax_encoding);
READ_VEC4(1, B1, sax_operands);
layout(binding = 2) uniform B2 { SaxSetup sax_setup; };
layout(binding = 3) readonly buffer B3 { SaxProduct sax_products[]; };
layout(binding = 4) buffer B4 { float sax_weight_parts[]; };
#include "inc/lineformer.glsl"

uint begin;
uint end;

uint place_of_part(uint number) { return gl_WorkGroupID.x * sax_setup.n_weights + number; }

float column_of(SaxProduct product, uint k, uint s) {
    if (product.right == SAX_FEATURES)
        return FETCH(sax_encoding, k / 4u * push.feature_stride + push.first_feature + s)[k % 4u];
    return operand(product.right, k / 4u, s)[k % 4u];
}

// Computes a lane's INPUTS columns: `first` and further ones at distances of the workgroup's size.
void add_product(SaxProduct product, uint first) {
    vec4 sums[WIDTH4][INPUTS];
    [[unroll]] for (uint j = 0u; j < WIDTH4; j++) {
        [[unroll]] for (uint i = 0u; i < INPUTS; i++) sums[j][i] = vec4(0.0);
    }
    uint columns[INPUTS];
    [[unroll]] for (uint i = 0u; i < INPUTS; i++) columns[i] = first + i * gl_WorkGroupSize.x;
    [[dont_unroll]] for (uint s = begin; s < end; s++) {
        float x[INPUTS];
        [[unroll]] for (uint i = 0u; i < INPUTS; i++) x[i] = column_of(product, min(columns[i], 4u * product.columns - 1u), s);
        [[unroll]] for (uint j = 0u; j < WIDTH4; j++) {
            vec4 d = operand(product.left, j, s);
            [[unroll]] for (uint i = 0u; i < INPUTS; i++) sums[j][i] += d * x[i];
        }
    }
    // One branch for all sums: a branch for each of them costs some compilers of CPU drivers gigabytes.
    [[unroll]] for (uint i = 0u; i < INPUTS; i++) {
        if (columns[i] >= 4u * product.columns) continue;
        uint place = place_of_part(4u * product.first + columns[i]);
        if (push.adds != 0u) {
            [[unroll]] for (uint row = 0u; row < 4u * WIDTH4; row++)
                sax_weight_parts[place + 4u * row * product.stride] += sums[row / 4u][i][row % 4u];
        } else {
            [[unroll]] for (uint row = 0u; row < 4u * WIDTH4; row++)
                sax_weight_parts[place + 4u * row * product.stride] = sums[row / 4u][i][row % 4u];
        }
    }
}

// Computes the sum of one vector over the samples.
void add_vector(SaxProduct product) {
    for (uint i = gl_LocalInvocationID.x; i < WIDTH4; i += gl_WorkGroupSize.x) {
        vec4 sum = vec4(0.0);
        for (uint s = begin; s < end; s++) sum += operand(product.left, i, s);
        uint place = place_of_part(4u * (product.first + i));
        [[unroll]] for (uint c = 0u; c < 4u; c++)
            sax_weight_parts[place + c] = sum[c] + (push.adds != 0u ? sax_weight_parts[place + c] : 0.0);
    }
}

void main() {
    begin = min(gl_WorkGroupID.x * push.part_samples, push.n_samples);
    end = min(begin + push.part_samples, push.n_samples);
    SaxProduct product = sax_products[gl_WorkGroupID.y];
    if (product.columns == 0u) {
        add_vector(product);
        return;
    }
    uint at_once = INPUTS * gl_WorkGroupSize.x;
    for (uint first = 0u; first < 4u * product.columns; first += at_once)
        add_product(product, first + gl_LocalInvocationID.x);
}
