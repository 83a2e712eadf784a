#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Scatters dL/d sigma_l to planes and lines: one workgroup per ray. Contributions are summed as 64-bit
// fixed point in pairs of 32-bit integer atomics, which is exact and hence independent of order.
//   static_gradient[2 * parameter] = low, high word.
#include "inc/layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
#include "inc/softplus.glsl"
#include "inc/operands.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_ray; uint n_rays; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { uint state[]; };
layout(binding = 2) readonly buffer B2 { Ray rays[]; };
layout(binding = 3) readonly buffer B3 { vec2 ray_gradient[]; };
READ_VEC4(4, B4, static_params);
layout(binding = 5) buffer B5 { uint static_gradient[]; };
#include "inc/tensor_vm.glsl"

// The magnitude is split exactly into words, then negated in two's complement.
void add_fixed(uint parameter, float value, float scale_high) {
    if (value == 0.0) return;
    float scaled = abs(value) * scale_high;
    float whole = floor(scaled);
    uint high = uint(whole);
    uint low = uint((scaled - whole) * 4294967296.0);
    if (value < 0.0) {
        low = ~low + 1u;
        high = ~high + (low == 0u ? 1u : 0u);
    }
    uint before = atomicAdd(static_gradient[2u * parameter], low);
    high += before + low < before ? 1u : 0u;
    if (high != 0u) atomicAdd(static_gradient[2u * parameter + 1u], high);
}

void add_fixed4(uint texel, vec4 value, float scale_high) {
    [[unroll]] for (uint c = 0u; c < 4u; c++) add_fixed(4u * texel + c, value[c], scale_high);
}

void main() {
    uint r = push.first_ray + gl_WorkGroupID.x;
    Ray ray = rays[r];
    float gradient = ray_gradient[r].x;
    if (gradient == 0.0) return;  // rays that skip the static field, too
    uint stream = setup.per_ray_depths != 0u ? ray.id + 1u : 0u;
    float scale_high = exp2(float(setup.fixed_point_bits) - 32.0);
    for (uint k = gl_LocalInvocationID.x; k < setup.n_static_samples; k += gl_WorkGroupSize.x) {
        float depth = depth_at(k, setup.n_static_samples, setup.static_near, setup.static_far, setup.jitter,
                               setup.seed, state[0], stream);
        vec3 x = ray.anchor + depth * ray.direction;
        if (!static_inside(x)) continue;
        float dl = path_length(depth, k, setup.n_static_samples, setup.static_near, setup.static_far, setup.jitter,
                                   setup.seed, state[0], stream, ray.norm);
        float at_feature = gradient * dl * setup.static_gain * sigmoid(vm_feature(x) + setup.static_shift);
        vec3 coordinate = vm_coordinate(x);
        for (uint mode = 0u; mode < 3u; mode++) {
            VmTaps taps = vm_taps(coordinate, mode);
            for (uint c = 0u; c < setup.rank4; c++) {
                vec4 to_plane = at_feature * vm_line(taps, c);
                vec4 to_line = at_feature * vm_plane(taps, c);
                [[unroll]] for (uint t = 0u; t < 4u; t++) {
                    add_fixed4(taps.plane[t] * setup.rank4 + c, taps.plane_weight[t] * to_plane, scale_high);
                }
                [[unroll]] for (uint t = 0u; t < 2u; t++) {
                    add_fixed4(taps.line[t] * setup.rank4 + c, taps.line_weight[t] * to_line, scale_high);
                }
            }
        }
    }
}
