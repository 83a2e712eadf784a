#version 450
#extension GL_GOOGLE_include_directive : require
// Forward pass of the whole network for a tile of samples in shared memory and registers: encoding, hidden layers, output
// neuron and activation. The bias and the latent of a layer that reads the encoding are columns of its weights, one per phase.
// They are multiplied by the shares of the phases, which follow the encoding. Their gradients are therefore part of the weight
// gradient.
//   features16[s][encoded], activations16_i[s][width]: f16, stored where the backward pass does not recompute them;
//   sample_sigma[s] = (sigma_s, d sigma_s / d feature).
//   weights16: per layer [width][encoded] if it reads the encoding, then [width][width] unless it is the first; at the end the
//     output weights, n rows of which only the first is used.
#include "inc/matrices.glsl"
#include "inc/layout.glsl"
#include "inc/sample_rays.glsl"
#include "inc/softplus.glsl"
#include "inc/phase_share.glsl"
layout(constant_id = 7) const uint encoded = 80u;     // numbers of the encoding and shares of the phases, padded
layout(constant_id = 8) const uint layers = 4u;       // number of hidden layers
layout(constant_id = 9) const uint skip = 0u;         // layer (from 0) that reads the encoding again; 0: none
layout(constant_id = 10) const uint keep_features = 1u;
layout(constant_id = 11) const uint keep_from = 0u;   // first layer whose activations are stored; `layers`: none
layout(push_constant) uniform Push { uint out_bias; } push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Schedule schedule[]; };
layout(binding = 3) readonly buffer B3 { LiveSamples live; };
layout(binding = 4) readonly buffer B4 { vec4 sample_points[]; };
layout(binding = 5) readonly buffer B5 { uint sample_rays[]; };
layout(binding = 6) readonly buffer B6 { Ray rays[]; };
layout(binding = 7) readonly buffer B7 { uvec4 weights16[]; };
layout(binding = 8) readonly buffer B8 { float bias_rows[]; };
layout(binding = 9) readonly buffer B9 { float params[]; };
layout(binding = 10) writeonly buffer B10 { uvec4 features16[]; };
layout(binding = 11) writeonly buffer B11 { uvec4 activations16[]; };
layout(binding = 12) writeonly buffer B12 { vec2 sample_sigma[]; };
#ifdef DECLARATIONS_ONLY
void main() {}
#else
#include "inc/encode_tile.glsl"

const uint width8 = width / 8u;
const uint encoded8 = encoded / 8u;
// One additional uvec4 per row avoids bank conflicts. A row must also hold the n sums of the output neuron that replace it at
// the end.
const uint hidden_stride = width8 + 1u > n / 4u ? width8 + 1u : n / 4u;
const uint encoded_stride = encoded8 + 1u;
// Without a skip layer the encoding is not used after the first layer, whose activations may overwrite it.
const uint encoded_at = skip > 0u ? tile * hidden_stride : 0u;
const uint shared_size = skip > 0u ? encoded_at + tile * encoded_stride
                                   : tile * (hidden_stride > encoded_stride ? hidden_stride : encoded_stride);
const uint row_tiles = tile / m;
const uint column_tiles = width / n / subgroups;
shared uvec4 tile16[shared_size];

// Each invocation writes eight numbers of a sample at a time.
void encode_tile(uint first) {
    for (uint e = gl_LocalInvocationIndex; e < tile * encoded8; e += gl_WorkGroupSize.x) {
        uvec4 numbers = encoded_numbers(first + e / encoded8, e % encoded8);
        tile16[encoded_at + e / encoded8 * encoded_stride + e % encoded8] = numbers;
        if (keep_features != 0u) features16[first * encoded8 + e] = numbers;
    }
}

SUM sums[row_tiles * column_tiles];

// Computes sums += input [tile][depth] times the transpose of weights [width][depth].
void multiply(uint input_at, uint input_stride, uint weights_at, uint depth, uint column0) {
    STEPS for (uint step = 0u; step < depth / k; step++) {
        [[unroll]] for (uint c = 0u; c < column_tiles; c++) {
            RIGHT weights;
            coopMatLoad(weights, weights16, (weights_at + (column0 + c * n) * depth + step * k) / 8u, depth / 8u, COLUMNS);
            [[unroll]] for (uint r = 0u; r < row_tiles; r++) {
                LEFT inputs;
                coopMatLoad(inputs, tile16, input_at + r * m * input_stride + step * k / 8u, input_stride, ROWS);
                sums[r * column_tiles + c] = coopMatMulAdd(inputs, weights, sums[r * column_tiles + c]);
            }
        }
    }
}

// Copies activations from the tile, which has whole rows. Stores from matrices would write only a few bytes at a time.
void keep_activations(uint kept, uint first) {
    uint at = (kept * setup.sample_capacity + first) * width8;
    for (uint e = gl_LocalInvocationIndex; e < tile * width8; e += gl_WorkGroupSize.x) {
        activations16[at + e] = tile16[e / width8 * hidden_stride + e % width8];
    }
}

void main() {
    uint first = gl_WorkGroupID.x * tile;
    uint column0 = gl_SubgroupID * (width / subgroups);
    encode_tile(first);
    barrier();
    uint weights_at = 0u;
    [[dont_unroll]] for (uint layer = 0u; layer < layers; layer++) {
        [[unroll]] for (uint c = 0u; c < column_tiles; c++) {
            SUM bias;
            coopMatLoad(bias, bias_rows, layer * m * width + column0 + c * n, width, ROWS);
            [[unroll]] for (uint r = 0u; r < row_tiles; r++) sums[r * column_tiles + c] = bias;
        }
        if (layer == 0u || layer == skip) {
            multiply(encoded_at, encoded_stride, weights_at, encoded, column0);
            weights_at += width * encoded;
        }
        if (layer > 0u) {
            multiply(0u, hidden_stride, weights_at, width, column0);
            weights_at += width * width;
        }
        barrier();
        [[unroll]] for (uint r = 0u; r < row_tiles; r++) {
            [[unroll]] for (uint c = 0u; c < column_tiles; c++) {
                SUM sum = sums[r * column_tiles + c];
                [[unroll]] for (uint i = 0u; i < sum.length(); i++) sum[i] = clamp(sum[i], 0.0, LARGEST);
                uint column = (column0 + c * n) / 8u;
                STORE_F16(sum, tile16, r * m * hidden_stride + column, hidden_stride);
            }
        }
        barrier();
        if (layer >= keep_from) keep_activations(layer - keep_from, first);
    }
    if (keep_from < layers) barrier();
    // Output neuron: the row tiles are distributed among the subgroups, and each subgroup accesses only its own rows from here
    // on.
    for (uint r = gl_SubgroupID; r < row_tiles; r += subgroups) {
        SUM sum = SUM(0.0);
        STEPS for (uint step = 0u; step < width / k; step++) {
            LEFT inputs;
            RIGHT weights;
            coopMatLoad(inputs, tile16, r * m * hidden_stride + step * k / 8u, hidden_stride, ROWS);
            coopMatLoad(weights, weights16, (weights_at + step * k) / 8u, width8, COLUMNS);
            sum = coopMatMulAdd(inputs, weights, sum);
        }
        subgroupBarrier();
        coopMatStore(sum, tile16, r * m * hidden_stride, hidden_stride, ROWS);
    }
    barrier();
    for (uint row = gl_LocalInvocationIndex; row < tile; row += gl_WorkGroupSize.x) {
        float x = uintBitsToFloat(tile16[row * hidden_stride].x) + params[push.out_bias] + setup.dynamic_shift;
        sample_sigma[first + row] = setup.dynamic_gain * vec2(softplus(x), sigmoid(x));
    }
}
#endif
