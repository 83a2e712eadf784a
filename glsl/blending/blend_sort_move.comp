#version 450
#extension GL_GOOGLE_include_directive : require
// Last pass of the sort by four bits: moves the keys to their positions. Keys with equal digits keep their order. One workgroup
// per block of 1024 keys.
#include "inc/blend_layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_keys; uint n_blocks; uint shift; } push;
layout(binding = 0) readonly buffer B0 { BlendKey blend_keys[]; };
layout(binding = 1) readonly buffer B1 { uint blend_set_of[]; };
// [digit][block]: sums of the preceding counts.
layout(binding = 2) readonly buffer B2 { uint blend_sort_counts[]; };
layout(binding = 3) writeonly buffer B3 { BlendKey blend_keys_moved[]; };
#include "inc/blend_sort.glsl"

void main() {
    uint digit = gl_LocalInvocationID.x;
    count_digits();
    if (workgroup() >= push.n_blocks) return;
    if (digit < DIGITS) {
        uint place = blend_sort_counts[digit * push.n_blocks + workgroup()];
        for (uint k = digit * gl_WorkGroupSize.x; k < (digit + 1u) * gl_WorkGroupSize.x; k++) {
            uint count = of_lanes[k];
            of_lanes[k] = place;
            place += count;
        }
    }
    barrier();
    uvec2 own = keys_of_lane();
    for (uint i = own.x; i < own.y; i++) {
        BlendKey key = blend_keys[i];
        uint at = digit_of(key) * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
        blend_keys_moved[of_lanes[at]] = key;
        of_lanes[at] += 1u;
    }
}
