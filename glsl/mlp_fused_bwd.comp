#version 450
#extension GL_GOOGLE_include_directive : require
// Backward through one hidden layer, for all live samples in tiles: gradient to its input and gradient of its
// weights in one pass. Workgroups persist: each walks every gl_NumWorkGroups-th tile and keeps its weight gradient
// in registers; the partial sums of all workgroups are added up later in a fixed order.
//   dz16[s][width]: gradient at the layer's neurons, times the loss scale; for the last layer formed here.
//   inputs16[s][columns]: activations of the layer below, or the encoding.
//   dz_in16[s][columns] = (W^T dz) where the input was on, if `with_input`.
//   partials[workgroup][n_partials]: weight gradient [width][columns] at `weights`, bias gradient at `bias`, and for
//   the last layer those of the output neuron at `out_weights` and `out_bias`; NOWHERE skips one.
#include "inc/matrices.glsl"
#include "inc/layout.glsl"
#include "inc/positions.glsl"
#include "inc/sample_rays.glsl"
layout(constant_id = 7) const uint columns = 128u;
layout(constant_id = 8) const uint with_input = 1u;
layout(constant_id = 9) const uint from_output = 0u;  // the layer is the last
layout(constant_id = 10) const uint halves = 2u;      // 1 or 2, a divisor of both subgroups and columns / n
layout(push_constant) uniform Push {
    uint weights_at; uint inputs_at; uint outputs_at; uint out_weights_at; uint n_partials; uint weights; uint bias;
    uint out_weights; uint out_bias; uint accumulate;
} push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { LiveSamples live; };
layout(binding = 3) readonly buffer B3 { vec4 sample_points[]; };
layout(binding = 4) readonly buffer B4 { uint sample_rays[]; };
layout(binding = 5) readonly buffer B5 { vec2 sample_sigma[]; };
layout(binding = 6) readonly buffer B6 { vec2 ray_gradient[]; };
layout(binding = 7) readonly buffer B7 { uvec4 weights16[]; };
layout(binding = 8) readonly buffer B8 { uvec4 inputs16[]; };
layout(binding = 9) readonly buffer B9 { uvec4 outputs16[]; };
layout(binding = 10) readonly buffer B10 { uvec4 dz16[]; };
layout(binding = 11) writeonly buffer B11 { uvec4 dz_in16[]; };
layout(binding = 12) buffer B12 { float partials[]; };
layout(binding = 13) readonly buffer B13 { float sigma_gradient[]; };

const uint width8 = width / 8u;
const uint columns8 = columns / 8u;
// One more uvec4 a row keeps rows off the same banks.
const uint dz_stride = width8 + 1u;
const uint input_stride = columns8 + 1u;
const uint row_tiles = tile / m;
// Weight gradient: subgroups are laid out in bands over neurons times halves over inputs.
const uint bands = subgroups / halves;
const uint grad_rows = (width / m + bands - 1u) / bands;
const uint grad_columns = columns / n / halves;
// Rows of the last band beyond the neurons: none unless m and n differ. A constant, so that drivers drop the tests.
const uint overhang = bands * grad_rows * m - width;
// Input gradient: column tiles are dealt out to subgroups, which divide those of hidden inputs evenly.
const uint input_tiles = columns / n / subgroups;
// Staging: an invocation keeps its eight neurons from tile to tile.
const uint stage_rows = gl_WorkGroupSize.x / width8 > 0u ? gl_WorkGroupSize.x / width8 : 1u;
const uint scratch = 2u * gl_WorkGroupSize.x;
shared uvec4 tile_dz[tile * dz_stride > scratch ? tile * dz_stride : scratch];
shared uvec4 tile_in[tile * input_stride];
shared float tile_gradient[tile];

SUM weight_gradient[grad_rows * grad_columns];
float bias_sum[8];
float out_sum[8];
float out_bias_sum;
// Largest gradient in f16: what is larger than any becomes infinite on some devices, the largest there is on others.
float largest;
shared uint overflowed;

#include "inc/sample_gradient.glsl"

float sample_gradient(uint s) {
    return s < live.count ? state.loss_scale * feature_gradient(s) : 0.0;
}

void stage(uint first) {
    if (from_output != 0u) {
        for (uint row = gl_LocalInvocationIndex; row < tile; row += gl_WorkGroupSize.x) {
            float g = sample_gradient(first + row);
            tile_gradient[row] = g;
            out_bias_sum += g;
        }
        barrier();
    }
    uint q = gl_LocalInvocationIndex % width8;
    uint row0 = gl_LocalInvocationIndex / width8;
    uvec4 out_weights = from_output != 0u ? weights16[push.out_weights_at / 8u + q] : uvec4(0u);
    for (uint row = row0; row < tile && row0 < stage_rows; row += stage_rows) {
        uvec4 packed;
        if (from_output != 0u) {
            uvec4 outputs = outputs16[push.outputs_at + (first + row) * width8 + q];
            [[unroll]] for (uint i = 0u; i < 4u; i++) {
                vec2 h = unpackHalf2x16(outputs[i]);
                out_sum[2u * i] += tile_gradient[row] * h.x;
                out_sum[2u * i + 1u] += tile_gradient[row] * h.y;
                vec2 dz = tile_gradient[row] * unpackHalf2x16(out_weights[i]);
                dz = mix(vec2(0.0), dz, greaterThan(h, vec2(0.0)));
                largest = max(largest, max(abs(dz.x), abs(dz.y)));
                packed[i] = packHalf2x16(dz);
            }
        } else {
            packed = dz16[(first + row) * width8 + q];
        }
        [[unroll]] for (uint i = 0u; i < 4u; i++) {
            vec2 dz = unpackHalf2x16(packed[i]);
            bias_sum[2u * i] += dz.x;
            bias_sum[2u * i + 1u] += dz.y;
        }
        tile_dz[row * dz_stride + q] = packed;
    }
    for (uint e = gl_LocalInvocationIndex; e < tile * columns8; e += gl_WorkGroupSize.x) {
        tile_in[e / columns8 * input_stride + e % columns8] = inputs16[push.inputs_at + first * columns8 + e];
    }
    barrier();
}

void input_gradient(uint first) {
    [[unroll]] for (uint c = 0u; c < input_tiles; c++) {
        uint column = (gl_SubgroupID + c * subgroups) * n;
        [[unroll]] for (uint r = 0u; r < row_tiles; r++) {
            SUM sum = SUM(0.0);
            STEPS for (uint step = 0u; step < width / k; step++) {
                LEFT dz;
                RIGHT weights;
                coopMatLoad(dz, tile_dz, r * m * dz_stride + step * k / 8u, dz_stride, ROWS);
                coopMatLoad(weights, weights16, (push.weights_at + step * k * columns + column) / 8u, columns8, ROWS);
                sum = coopMatMulAdd(dz, weights, sum);
            }
            // Element order may differ between component types, so the mask is applied between equal types.
            SUM16 gradient = SUM16(sum), on;
            coopMatLoad(on, tile_in, r * m * input_stride + column / 8u, input_stride, ROWS);
            [[unroll]] for (uint i = 0u; i < gradient.length(); i++) {
                gradient[i] = on[i] > float16_t(0.0) ? gradient[i] : float16_t(0.0);
                largest = max(largest, abs(float(gradient[i])));
            }
            coopMatStore(gradient, dz_in16, (first + r * m) * columns8 + column / 8u, columns8, ROWS);
        }
    }
}

void add_weight_gradient(uint row0, uint column0) {
    STEPS for (uint step = 0u; step < tile / k; step++) {
        LEFT dz[grad_rows];
        [[unroll]] for (uint r = 0u; r < grad_rows; r++) {
            if (overhang == 0u || row0 + r * m < width) {
                coopMatLoad(dz[r], tile_dz, step * k * dz_stride + (row0 + r * m) / 8u, dz_stride, COLUMNS);
            }
        }
        [[unroll]] for (uint c = 0u; c < grad_columns; c++) {
            RIGHT inputs;
            coopMatLoad(inputs, tile_in, step * k * input_stride + (column0 + c * n) / 8u, input_stride, ROWS);
            [[unroll]] for (uint r = 0u; r < grad_rows; r++) {
                if (overhang == 0u || row0 + r * m < width) {
                    weight_gradient[r * grad_columns + c] =
                        coopMatMulAdd(dz[r], inputs, weight_gradient[r * grad_columns + c]);
                }
            }
        }
    }
}

void put(uint at, float value) {
    partials[at] = value + (push.accumulate != 0u ? partials[at] : 0.0);
}

// Adds the eight sums of each invocation over the rows of staging, in row order.
void put_neuron_sums(float sums[8], uint at) {
    barrier();
    [[unroll]] for (uint i = 0u; i < 2u; i++) {
        tile_dz[2u * gl_LocalInvocationIndex + i] =
            floatBitsToUint(vec4(sums[4u * i], sums[4u * i + 1u], sums[4u * i + 2u], sums[4u * i + 3u]));
    }
    barrier();
    for (uint neuron = gl_LocalInvocationIndex; neuron < width; neuron += gl_WorkGroupSize.x) {
        float total = 0.0;
        for (uint row = 0u; row < stage_rows; row++) {
            total += uintBitsToFloat(tile_dz[2u * (row * width8 + neuron / 8u) + (neuron & 7u) / 4u][neuron & 3u]);
        }
        put(at + neuron, total);
    }
}

void main() {
    uint row0 = gl_SubgroupID / halves * grad_rows * m;
    uint column0 = gl_SubgroupID % halves * grad_columns * n;
    [[unroll]] for (uint i = 0u; i < grad_rows * grad_columns; i++) weight_gradient[i] = SUM(0.0);
    [[unroll]] for (uint i = 0u; i < 8u; i++) {
        bias_sum[i] = 0.0;
        out_sum[i] = 0.0;
    }
    out_bias_sum = 0.0;
    largest = 0.0;
    overflowed = 0u;
    uint tiles = (live.padded + tile - 1u) / tile;
    [[dont_unroll]] for (uint t = gl_WorkGroupID.x; t < tiles; t += gl_NumWorkGroups.x) {
        stage(t * tile);
        if (with_input != 0u) input_gradient(t * tile);
        add_weight_gradient(row0, column0);
        barrier();
    }
    barrier();
    if (largest >= LARGEST) overflowed = 1u;
    barrier();
    uint mine = gl_WorkGroupID.x * push.n_partials;
    [[unroll]] for (uint r = 0u; r < grad_rows; r++) {
        if (overhang == 0u || row0 + r * m < width) {
            [[unroll]] for (uint c = 0u; c < grad_columns; c++) {
                uint at = mine + push.weights + (row0 + r * m) * columns + column0 + c * n;
                SUM sum = weight_gradient[r * grad_columns + c];
                // An overflow must show in the sums, for the loss scale to give way.
                if (r == 0u && c == 0u && overflowed != 0u) sum[0] = uintBitsToFloat(0x7f800000u);
                if (push.accumulate != 0u) {
                    SUM before;
                    coopMatLoad(before, partials, at, columns, ROWS);
                    sum = sum + before;
                }
                coopMatStore(sum, partials, at, columns, ROWS);
            }
        }
    }
    if (push.bias != NOWHERE) put_neuron_sums(bias_sum, mine + push.bias);
    if (push.out_weights != NOWHERE) {
        put_neuron_sums(out_sum, mine + push.out_weights);
        barrier();
        tile_dz[gl_LocalInvocationIndex].x = floatBitsToUint(out_bias_sum);
        barrier();
        if (gl_LocalInvocationIndex == 0u) {
            float total = 0.0;
            for (uint i = 0u; i < gl_WorkGroupSize.x; i++) total += uintBitsToFloat(tile_dz[i].x);
            put(mine + push.out_bias, total);
        }
    }
}
