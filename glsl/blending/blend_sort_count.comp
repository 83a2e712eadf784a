#version 450
#extension GL_GOOGLE_include_directive : require
// First pass of the sort by four bits: counts of each digit in each block of 1024 keys. One workgroup per block.
#include "inc/blend_layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_keys; uint n_blocks; uint shift; } push;
layout(binding = 0) readonly buffer B0 { BlendKey blend_keys[]; };
layout(binding = 1) readonly buffer B1 { uint blend_set_of[]; };
// [digit][block]
layout(binding = 2) writeonly buffer B2 { uint blend_sort_counts[]; };
#include "inc/blend_sort.glsl"

void main() {
    uint digit = gl_LocalInvocationID.x;
    count_digits();
    if (digit >= DIGITS || workgroup() >= push.n_blocks) return;
    uint sum = 0u;
    for (uint lane = 0u; lane < gl_WorkGroupSize.x; lane++) sum += of_lanes[digit * gl_WorkGroupSize.x + lane];
    blend_sort_counts[digit * push.n_blocks + workgroup()] = sum;
}
