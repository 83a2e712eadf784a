// Rays of a workgroup, each with `ray_lanes` neighbouring lanes. This file must be included after the layout with the size of
// the workgroup. It needs `push.n_rays`.
#include "inc/combine.glsl"
layout(constant_id = 2) const uint rays_of_workgroup = 1u;
const uint ray_lanes = gl_WorkGroupSize.x / rays_of_workgroup;

// Index of this lane among the lanes of its ray.
uint ray_lane() { return workgroup_lane() % ray_lanes; }

// Index of this lane's ray in the workgroup. The form of the expression shows compilers that all lanes of a subgroup may have
// an equal result.
uint ray_of_workgroup() {
    if (rays_of_workgroup == 1u) return 0u;
#ifdef SUBGROUP
    if (ray_lanes >= gl_SubgroupSize) return gl_SubgroupID / (ray_lanes / gl_SubgroupSize);
#endif
    return workgroup_lane() / ray_lanes;
}

uint place_of_ray() { return gl_WorkGroupID.x * rays_of_workgroup + ray_of_workgroup(); }

// Whether this lane has a ray; a chunk may end within a workgroup.
bool has_ray() { return place_of_ray() < push.n_rays; }

// Index of this lane's ray in the chunk. A lane without a ray gets the last one, so that all lanes reach the barriers.
uint ray_of_chunk() { return min(place_of_ray(), push.n_rays - 1u); }
