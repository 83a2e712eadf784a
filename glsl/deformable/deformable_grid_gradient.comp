#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient of the grid's displacements: the contributions of the Gaussians around each node, in their order, and of the
// smoothness penalty on squared differences of neighbouring nodes. It is zero at the rest phase. One invocation per node (x)
// and PHASES phases (y), because a Gaussian's share of a node is equal at all phases.
#include "inc/gaussian.glsl"
#include "inc/deformable_grid.glsl"
#ifndef PHASES
#define PHASES 5u
#endif
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_gaussians; uint first_phase; uint n_phases; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { MotionGridSetup deformable_setup; };
layout(binding = 2) readonly buffer B2 { Gaussian gaussians[]; };
layout(binding = 3) readonly buffer B3 { vec4 place_gradient[]; };
layout(binding = 4) readonly buffer B4 { vec4 motion_grid[]; };
layout(binding = 5) writeonly buffer B5 { vec4 motion_grid_gradient[]; };

void main() {
    uint n = deformable_setup.n_nodes, index = gl_GlobalInvocationID.x, n_nodes = n * n * n;
    if (index >= n_nodes) return;
    uint begin = gl_WorkGroupID.y * PHASES, end = min(begin + PHASES, push.n_phases);
    uvec3 node = uvec3(index % n, index / n % n, index / (n * n));
    vec4 sums[PHASES];
    for (uint t = 0u; t < PHASES; t++) sums[t] = vec4(0.0);
    for (uint i = 0u; i < push.n_gaussians; i++) {
        float share = node_share(on_grid(gaussians[i].position, deformable_setup), node);
        if (share == 0.0) continue;
        for (uint t = begin; t < end; t++)
            sums[t - begin] += share * place_gradient[(push.first_phase + t) * push.n_gaussians + i];
    }
    for (uint t = begin; t < end; t++) {
        uint at = (push.first_phase + t) * n_nodes + index;
        vec4 here = motion_grid[at], bend = vec4(0.0);
        uint stride = 1u;
        for (uint axis = 0u; axis < 3u; axis++) {
            if (node[axis] > 0u) bend += here - motion_grid[at - stride];
            if (node[axis] + 1u < n) bend += here - motion_grid[at + stride];
            stride *= n;
        }
        bool rests = push.first_phase + t == deformable_setup.rest_phase;
        motion_grid_gradient[at] = rests ? vec4(0.0) : sums[t - begin] + 2.0 * deformable_setup.smoothness * bend;
    }
}
