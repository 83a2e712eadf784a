#version 450
#extension GL_GOOGLE_include_directive : require
// Initial displacements of a phase for tracking: those of the phase before plus half of their last change. One invocation per
// node.
#include "inc/gaussian.glsl"
#include "inc/deformable_grid.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint phase; uint before; uint before_that; } push;
layout(binding = 0) uniform B0 { MotionGridSetup deformable_setup; };
layout(binding = 1) buffer B1 { vec4 motion_grid[]; };

void main() {
    uint n_nodes = deformable_setup.n_nodes * deformable_setup.n_nodes * deformable_setup.n_nodes, i = gl_GlobalInvocationID.x;
    if (i >= n_nodes) return;
    vec4 last = motion_grid[push.before * n_nodes + i];
    motion_grid[push.phase * n_nodes + i] = last + 0.5 * (last - motion_grid[push.before_that * n_nodes + i]);
}
