// Which splat an invocation works on, and which pixels of its box. With SUBGROUP, lanes of a full subgroup share a splat.
// Included behind the layout that gives the size of the workgroup, without which it would count as 1.

#include "inc/workgroup.glsl"

#ifdef SUBGROUP
#extension GL_KHR_shader_subgroup_basic : require
#extension GL_KHR_shader_subgroup_shuffle : require
layout(constant_id = 1) const uint lanes_per_splat = 8u;    // power of two, at most a subgroup

uint splat_index() {
    uint invocation = (workgroup() * gl_NumSubgroups + gl_SubgroupID) * gl_SubgroupSize + gl_SubgroupInvocationID;
    return invocation / lanes_per_splat;
}

uint splat_lane() { return gl_SubgroupInvocationID % lanes_per_splat; }

// Sum over the lanes of a splat, in a fixed order; all get it.
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

// Pixels of a box in their order, as far as they are this lane's.
struct Walk {
    uint k;         // number of the pixel in the box
    ivec2 at;       // where it is
    ivec2 stride;   // to the lane's next, but for the end of the row
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
