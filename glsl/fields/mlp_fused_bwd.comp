#version 450
#extension GL_GOOGLE_include_directive : require
// Backward pass through one hidden layer, or through two at once, for all live samples in tiles: the gradient of the layer's
// input and the weight gradient. Each workgroup processes every gl_NumWorkGroups-th tile and keeps its weight gradients in
// registers. The partial sums of all workgroups are added up later in a fixed order.
//   dz16[s][width]: gradient of the upper layer's neurons times the loss scale; this kernel computes it itself for the last
//     layer.
//   inputs16[s][upper_columns]: input of the upper layer, which is the activations of the layer below or the encoding;
//   lower_inputs16[s][lower_columns]: input of the lower layer, whose dz stays in shared memory.
//   dz_in16[s][width] = (W^T dz) where the input is positive, if `with_input`; W is that of the lower layer if there is one.
//   partials[workgroup][n_partials]: weight gradients [width][inputs] at `weights_at` and `lower_weights_at`, bias gradients at
//     `bias` and `lower_bias`, and for the last layer the gradients of the output neuron at `out_weights` and `out_bias`. An
//     output at NOWHERE is skipped.
#include "inc/matrices.glsl"
#include "inc/layout.glsl"
#include "inc/positions.glsl"
#include "inc/sample_rays.glsl"
layout(constant_id = 7) const uint upper_columns = 128u; // number of inputs of the upper layer
layout(constant_id = 8) const uint lower_columns = 0u;  // number of inputs of the lower layer; 0: no lower layer
layout(constant_id = 9) const uint shares = 2u;         // parts of the columns; a divisor of subgroups
layout(constant_id = 10) const uint lower_shares = 1u;  // parts of the lower layer's columns; a divisor of subgroups
layout(constant_id = 11) const uint with_input = 1u;
layout(constant_id = 12) const uint from_output = 0u;   // 1: the upper layer is the last hidden layer
layout(push_constant) uniform Push {
    uint weights_at; uint lower_weights_at; uint inputs_at; uint lower_inputs_at; uint outputs_at; uint out_weights_at;
    uint n_partials; uint bias; uint lower_bias; uint out_weights; uint out_bias; uint accumulate;
} push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { LiveSamples live; };
layout(binding = 3) readonly buffer B3 { vec4 sample_points[]; };
layout(binding = 4) readonly buffer B4 { uint sample_rays[]; };
layout(binding = 5) readonly buffer B5 { vec2 sample_sigma[]; };
layout(binding = 6) readonly buffer B6 { vec2 ray_gradient[]; };
layout(binding = 7) readonly buffer B7 { uvec4 weights16[]; };
layout(binding = 8) readonly buffer B8 { uvec4 inputs16[]; };
layout(binding = 9) readonly buffer B9 { uvec4 lower_inputs16[]; };
layout(binding = 10) readonly buffer B10 { uvec4 outputs16[]; };
layout(binding = 11) readonly buffer B11 { uvec4 dz16[]; };
layout(binding = 12) writeonly buffer B12 { uvec4 dz_in16[]; };
layout(binding = 13) buffer B13 { float partials[]; };
layout(binding = 14) readonly buffer B14 { float sigma_gradient[]; };
#ifdef DECLARATIONS_ONLY
void main() {}
#else
#include "inc/sample_gradient.glsl"
// Shared memory holds in turn the last layer's activations, the input of the upper layer and the input of the lower layer.
#define INPUTS_SIZE tile * (longest_stride > dz_stride ? longest_stride : dz_stride)
#include "inc/fused_backward.glsl"

shared float tile_gradient[tile];
// Gradients of the output neuron's weights and bias.
float out_sum[lane_neurons];
float out_bias_sum;

float sample_gradient(uint s) {
    return s < live.count ? state.loss_scale * feature_gradient(s) : 0.0;
}

void stage_output_gradient(uint first) {
    for (uint row = gl_LocalInvocationIndex; row < tile; row += gl_WorkGroupSize.x) {
        float g = sample_gradient(first + row);
        tile_gradient[row] = g;
        out_bias_sum += g;
    }
    barrier();
}

void add_outputs() {
    uint part = gl_LocalInvocationIndex / width;
    [[unroll]] for (uint i = 0u; i < lane_neurons; i++) {
        uint neuron = gl_LocalInvocationIndex % width + i * gl_WorkGroupSize.x;
        if (part >= row_parts || neuron >= width) continue;
        for (uint row = part; row < tile; row += row_parts) {
            out_sum[i] += tile_gradient[row] * neuron_of(tile_in[row * dz_stride + neuron / 8u], neuron);
        }
    }
}

// Eight numbers of the last layer's dz of a sample, from a row of the tile.
uvec4 output_dz(uint row, uint q) {
    uvec4 out_weights = weights16[push.out_weights_at / 8u + q];
    uvec4 outputs = tile_in[row * dz_stride + q];
    uvec4 packed;
    [[unroll]] for (uint i = 0u; i < 4u; i++) {
        vec2 dz = tile_gradient[row] * unpackHalf2x16(out_weights[i]);
        dz = mix(vec2(0.0), dz, greaterThan(unpackHalf2x16(outputs[i]), vec2(0.0)));
        largest = max(largest, max(abs(dz.x), abs(dz.y)));
        packed[i] = packHalf2x16(dz);
    }
    return packed;
}

// Computes the last layer's dz from its activations. These occupy the memory that holds the layer's input later.
void form_dz(uint first) {
    stage_output_gradient(first);
    if (push.out_weights != NOWHERE) add_outputs();
    [[unroll]] for (uint i = 0u; i < PARTS(dz_size); i++) {
        uint e = gl_LocalInvocationIndex + i * gl_WorkGroupSize.x;
        if (IN_PART(e, dz_size)) tile_dz[e / width8 * dz_stride + e % width8] = output_dz(e / width8, e % width8);
    }
    barrier();
}

void stage(uint first) {
    uvec4 dz[PARTS(dz_size)];
    uvec4 inputs[PARTS(input_size)];
    if (from_output != 0u) {
        FETCH(dz, outputs16, push.outputs_at + first * width8, dz_size);
    } else {
        FETCH(dz, dz16, first * width8, dz_size);
    }
    FETCH(inputs, inputs16, push.inputs_at + first * upper_columns8, input_size);
    if (from_output != 0u) {
        PLACE(dz, tile_in, width8, dz_stride, dz_size);
        form_dz(first);
    } else {
        PLACE(dz, tile_dz, width8, dz_stride, dz_size);
    }
    PLACE(inputs, tile_in, upper_columns8, input_stride, input_size);
}

void store_input_gradient(uint first, uint weights_at) {
    [[unroll]] for (uint c = 0u; c < input_columns; c++) {
        GRADIENT gradient[input_rows];
        input_gradient(weights_at, gradient_column(c), gradient);
        [[unroll]] for (uint r = 0u; r < input_rows; r++) {
            uint at = (first + gradient_row(r)) * width8 + gradient_column(c) / 8u;
            STORE_F16(gradient[r], dz_in16, at, width8);
        }
    }
}

void put_output_sums() {
    uint mine = gl_WorkGroupID.x * push.n_partials;
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

void walk_tile(uint first) {
    stage(first);
    barrier();
    if (push.bias != NOWHERE) add_dz(bias_sum);
    add_weight_gradient(upper_share(), 0u, input_stride);
    if (lower_columns != 0u) {
        descend();
        uvec4 inputs[PARTS(lower_size)];
        FETCH(inputs, lower_inputs16, push.lower_inputs_at + first * lower_columns8, lower_size);
        PLACE(inputs, tile_in, lower_columns8, lower_stride, lower_size);
        barrier();
        if (push.lower_bias != NOWHERE) add_dz(lower_bias_sum);
        add_weight_gradient(lower_share(), 0u, lower_stride);
    }
    if (with_input != 0u) store_input_gradient(first, lower_columns != 0u ? push.lower_weights_at : push.weights_at);
    barrier();
}

void main() {
    clear_sums();
    [[unroll]] for (uint i = 0u; i < lane_neurons; i++) out_sum[i] = 0.0;
    out_bias_sum = 0.0;
    uint tiles = tiles_of(live.padded);
    [[dont_unroll]] for (uint t = gl_WorkGroupID.x; t < tiles; t += gl_NumWorkGroups.x) walk_tile(t * tile);
    put_sums();
    if (push.out_weights != NOWHERE) put_output_sums();
}
#endif
