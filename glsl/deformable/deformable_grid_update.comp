#version 450
#extension GL_GOOGLE_include_directive : require
// Adam's update of the grid's displacements, except at the rest phase. One invocation per node (x) and phase (y).
#include "inc/gaussian.glsl"
#include "inc/deformable_grid.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_phase; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { MotionGridSetup deformable_setup; };
layout(binding = 2) readonly buffer B2 { GaussianSchedule gaussian_schedule[]; };
layout(binding = 3) readonly buffer B3 { uint gaussian_step; };
layout(binding = 4) readonly buffer B4 { vec4 motion_grid_gradient[]; };
layout(binding = 5) buffer B5 { vec4 motion_grid[]; };
layout(binding = 6) buffer B6 { vec4 motion_grid_first[]; };
layout(binding = 7) buffer B7 { vec4 motion_grid_second[]; };
#include "inc/gaussian_adam.glsl"

void main() {
    uint n_nodes = deformable_setup.n_nodes * deformable_setup.n_nodes * deformable_setup.n_nodes;
    uint phase = push.first_phase + gl_WorkGroupID.y;
    if (gl_GlobalInvocationID.x >= n_nodes || phase == deformable_setup.rest_phase) return;
    uint at = phase * n_nodes + gl_GlobalInvocationID.x;
    vec4 first = motion_grid_first[at], second = motion_grid_second[at];
    GaussianSchedule now = gaussian_schedule[gaussian_step];
    motion_grid[at] -= adam(motion_grid_gradient[at], vec4(deformable_setup.grid_rate), now, first, second);
    motion_grid_first[at] = first;
    motion_grid_second[at] = second;
}
