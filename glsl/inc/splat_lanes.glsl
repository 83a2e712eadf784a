// Assignment of splats and of their boxes' pixels to invocations. With SUBGROUP, lanes of a full subgroup share a splat. This
// file must be included after the layout with the size of the workgroup, which would count as 1 otherwise.

#include "inc/workgroup.glsl"

#ifdef SUBGROUP
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
layout(constant_id = 1) const uint lanes_per_splat = 8u;    // power of two, up to the size of a subgroup

uint splat_index() {
    uint invocation = (workgroup() * gl_NumSubgroups + gl_SubgroupID) * gl_SubgroupSize + gl_SubgroupInvocationID;
    return invocation / lanes_per_splat;
}

uint splat_lane() { return gl_SubgroupInvocationID % lanes_per_splat; }

// Sum over the lanes of a splat in a fixed order; all lanes get the result.
vec3 splat_sum(vec3 value) {
    for (uint apart = lanes_per_splat / 2u; apart > 0u; apart /= 2u) value += subgroupShuffleXor(value, apart);
    return value;
}
#else
const uint lanes_per_splat = 1u;

uint splat_index() { return invocation(); }
uint splat_lane() { return 0u; }
vec3 splat_sum(vec3 value) { return value; }
#endif

// Iteration over those pixels of a box that belong to this lane, in their order.
struct Walk {
    uint k;         // index of the pixel in the box
    ivec2 at;       // column and row of the pixel
    ivec2 stride;   // step to the lane's next pixel, without the change at the end of the row
};

Walk walk_from(ivec4 box) {
    uint width = uint(max(box.z - box.x + 1, 1)), k = splat_lane();
    return Walk(k, box.xy + ivec2(k % width, k / width), ivec2(lanes_per_splat % width, lanes_per_splat / width));
}

void walk_on(inout Walk walk, ivec4 box) {
    walk.k += lanes_per_splat;
    walk.at += walk.stride;
    if (walk.at.x > box.z) walk.at += ivec2(box.x - box.z - 1, 1);
}
