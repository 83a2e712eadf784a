// Rays of a workgroup, each with `ray_lanes` neighbouring lanes. Included behind the layout that gives the size of the workgroup;
// needs push.n_rays.
#include "inc/combine.glsl"
layout(constant_id = 2) const uint rays_of_workgroup = 1u;
const uint ray_lanes = gl_WorkGroupSize.x / rays_of_workgroup;

// This lane's place among those of its ray.
uint ray_lane() { return workgroup_lane() % ray_lanes; }

// Of this lane's ray among those of the workgroup. Said in a way that shows compilers where all lanes of a subgroup have the same.
uint ray_of_workgroup() {
    if (rays_of_workgroup == 1u) return 0u;
#ifdef SUBGROUP
    if (ray_lanes >= gl_SubgroupSize) return gl_SubgroupID / (ray_lanes / gl_SubgroupSize);
#endif
    return workgroup_lane() / ray_lanes;
}

uint place_of_ray() { return gl_WorkGroupID.x * rays_of_workgroup + ray_of_workgroup(); }

// Whether this lane has a ray: a chunk may end within a workgroup.
bool has_ray() { return place_of_ray() < push.n_rays; }

// This lane's ray, counted within the chunk; without one, the last, so that all lanes meet at barriers.
uint ray_of_chunk() { return min(place_of_ray(), push.n_rays - 1u); }
