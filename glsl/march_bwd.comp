#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Scatters dL/d sigma_l to planes and lines: one workgroup per ray. Contributions are summed as 64-bit
// fixed point in pairs of 32-bit integer atomics, which is exact and hence independent of order.
// Every sample of every ray meets the few texels of the lines: with `private_lines` a workgroup sums its own in shared
// memory first, so that they reach memory once per ray.
//   static_gradient[2 * parameter] = low, high word.
#include "inc/layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
#include "inc/softplus.glsl"
#include "inc/fixed_point.glsl"
#include "inc/operands.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(constant_id = 1) const uint private_lines = 0u;  // numbers on all lines, or 0: straight to memory
layout(push_constant) uniform Push { uint first_ray; uint n_rays; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Ray rays[]; };
layout(binding = 3) readonly buffer B3 { vec2 ray_gradient[]; };
READ_VEC4(4, B4, static_params);
layout(binding = 5) buffer B5 { uint static_gradient[]; };
#include "inc/tensor_vm.glsl"

shared uint line_sums[2u * private_lines + 1u];

void add_to_memory(uint parameter, uvec2 fixed_point) {
    ADD_FIXED(static_gradient, parameter, fixed_point);
}

void add_to_plane(uint texel, vec4 value, float scale_high) {
    [[unroll]] for (uint c = 0u; c < 4u; c++) {
        if (value[c] != 0.0) add_to_memory(4u * texel + c, to_fixed(value[c], scale_high));
    }
}

void add_to_line(uint texel, vec4 value, float scale_high) {
    uint first = setup.static_params - private_lines;
    [[unroll]] for (uint c = 0u; c < 4u; c++) {
        if (value[c] == 0.0) continue;
        uvec2 fixed_point = to_fixed(value[c], scale_high);
        if (private_lines == 0u) {
            add_to_memory(4u * texel + c, fixed_point);
        } else {
            ADD_FIXED(line_sums, 4u * texel + c - first, fixed_point);
        }
    }
}

void main() {
    uint r = push.first_ray + gl_WorkGroupID.x;
    Ray ray = rays[r];
    float gradient = ray_gradient[r].x;
    if (gradient == 0.0) return;  // rays that skip the static field, too
    for (uint i = gl_LocalInvocationID.x; i < 2u * private_lines; i += gl_WorkGroupSize.x) line_sums[i] = 0u;
    barrier();
    uint stream = setup.per_ray_depths != 0u ? ray.id + 1u : 0u;
    float scale_high = exp2(float(setup.fixed_point_bits) - 32.0);
    for (uint k = gl_LocalInvocationID.x; k < setup.n_static_samples; k += gl_WorkGroupSize.x) {
        float depth = depth_at(k, setup.n_static_samples, setup.static_near, setup.static_far, setup.jitter,
                               setup.seed, state.step, stream);
        vec3 x = ray.anchor + depth * ray.direction;
        if (!static_inside(x)) continue;
        float dl = path_length(depth, k, setup.n_static_samples, setup.static_near, setup.static_far, setup.jitter,
                                   setup.seed, state.step, stream, ray.norm);
        float at_feature = gradient * dl * setup.static_gain * sigmoid(vm_feature(x) + setup.static_shift);
        vec3 coordinate = vm_coordinate(x);
        for (uint mode = 0u; mode < 3u; mode++) {
            VmTaps taps = vm_taps(coordinate, mode);
            for (uint c = 0u; c < setup.rank4; c++) {
                vec4 to_plane = at_feature * vm_line(taps, c);
                vec4 to_line = at_feature * vm_plane(taps, c);
                [[unroll]] for (uint t = 0u; t < 4u; t++) {
                    add_to_plane(taps.plane[t] * setup.rank4 + c, taps.plane_weight[t] * to_plane, scale_high);
                }
                [[unroll]] for (uint t = 0u; t < 2u; t++) {
                    add_to_line(taps.line[t] * setup.rank4 + c, taps.line_weight[t] * to_line, scale_high);
                }
            }
        }
    }
    barrier();
    for (uint i = gl_LocalInvocationID.x; i < private_lines; i += gl_WorkGroupSize.x) {
        uvec2 sum = uvec2(line_sums[2u * i], line_sums[2u * i + 1u]);
        if (sum != uvec2(0u)) add_to_memory(setup.static_params - private_lines + i, sum);
    }
}
