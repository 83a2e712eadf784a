#version 450
#extension GL_GOOGLE_include_directive : require
// Backward pass through the second and the first hidden layer, like mlp_fused_bwd. The encoding and the first layer's
// activations are recomputed here, so that the forward pass need not store them.
//   dz16[s][width]: gradient of the second layer's neurons times the loss scale.
//   partials[workgroup][n_partials]: weight gradients [width][width] at `weights_at` and [width][lower_columns] at
//     `lower_weights_at`, bias gradients at `bias` and `lower_bias`. An output at NOWHERE is skipped.
#include "inc/matrices.glsl"
#include "inc/layout.glsl"
#include "inc/positions.glsl"
#include "inc/sample_rays.glsl"
#include "inc/phase_share.glsl"
#define upper_columns width
layout(constant_id = 7) const uint lower_columns = 80u; // numbers of the encoding and shares of the phases, padded
layout(constant_id = 8) const uint shares = 2u;         // parts of the columns; a divisor of subgroups
layout(constant_id = 9) const uint lower_shares = 1u;   // parts of the lower layer's columns; a divisor of subgroups
layout(push_constant) uniform Push {
    uint weights_at; uint lower_weights_at; uint n_partials; uint bias; uint lower_bias; uint accumulate;
} push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Schedule schedule[]; };
layout(binding = 3) readonly buffer B3 { LiveSamples live; };
layout(binding = 4) readonly buffer B4 { vec4 sample_points[]; };
layout(binding = 5) readonly buffer B5 { uint sample_rays[]; };
layout(binding = 6) readonly buffer B6 { Ray rays[]; };
layout(binding = 7) readonly buffer B7 { uvec4 weights16[]; };
layout(binding = 8) readonly buffer B8 { float bias_rows[]; };
layout(binding = 9) readonly buffer B9 { uvec4 dz16[]; };
layout(binding = 10) buffer B10 { float partials[]; };
#ifdef DECLARATIONS_ONLY
void main() {}
#else
#include "inc/encode_tile.glsl"
// Activations, followed by the encoding.
#define INPUTS_SIZE tile * (input_stride + lower_stride)
#include "inc/fused_backward.glsl"

const uint encoded_at = tile * input_stride;

void stage(uint first) {
    uvec4 dz[PARTS(dz_size)];
    FETCH(dz, dz16, first * width8, dz_size);
    for (uint e = gl_LocalInvocationIndex; e < tile * lower_columns8; e += gl_WorkGroupSize.x) {
        uint row = e / lower_columns8;
        tile_in[encoded_at + row * lower_stride + e % lower_columns8] = encoded_numbers(first + row, e % lower_columns8);
    }
    PLACE(dz, tile_dz, width8, dz_stride, dz_size);
}

// Computes the first layer's activations as in the forward pass.
void activate() {
    [[unroll]] for (uint c = 0u; c < input_columns; c++) {
        uint column = gradient_column(c);
        SUM sums[input_rows];
        [[unroll]] for (uint r = 0u; r < input_rows; r++) coopMatLoad(sums[r], bias_rows, column, width, ROWS);
        [[dont_unroll]] for (uint step = 0u; step < lower_columns / k; step++) {
            RIGHT weights;
            coopMatLoad(weights, weights16, (push.lower_weights_at + column * lower_columns + step * k) / 8u,
                        lower_columns8, COLUMNS);
            [[unroll]] for (uint r = 0u; r < input_rows; r++) {
                LEFT inputs;
                uint at = encoded_at + gradient_row(r) * lower_stride + step * k / 8u;
                coopMatLoad(inputs, tile_in, at, lower_stride, ROWS);
                sums[r] = coopMatMulAdd(inputs, weights, sums[r]);
            }
        }
        [[unroll]] for (uint r = 0u; r < input_rows; r++) {
            SUM sum = sums[r];
            [[unroll]] for (uint i = 0u; i < sum.length(); i++) sum[i] = clamp(sum[i], 0.0, LARGEST);
            STORE_F16(sum, tile_in, gradient_row(r) * input_stride + column / 8u, input_stride);
        }
    }
}

void walk_tile(uint first) {
    stage(first);
    barrier();
    activate();
    if (push.bias != NOWHERE) add_dz(bias_sum);
    barrier();
    add_weight_gradient(upper_share(), 0u, input_stride);
    descend();
    barrier();
    if (push.lower_bias != NOWHERE) add_dz(lower_bias_sum);
    add_weight_gradient(lower_share(), encoded_at, lower_stride);
    barrier();
}

void main() {
    clear_sums();
    uint tiles = tiles_of(live.padded);
    [[dont_unroll]] for (uint t = gl_WorkGroupID.x; t < tiles; t += gl_NumWorkGroups.x) walk_tile(t * tile);
    put_sums();
}
#endif
