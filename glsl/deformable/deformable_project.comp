#version 450
#extension GL_GOOGLE_include_directive : require
// Projects every Gaussian of the deformable set into every view at each of some phases. One invocation per Gaussian (x) and per
// phase and view (y).
#include "inc/gaussian.glsl"
#include "inc/deformable_grid.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_gaussians; uint first_phase; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { MotionGridSetup deformable_setup; };
layout(binding = 2) readonly buffer B2 { GaussianView gaussian_views[]; };
layout(binding = 3) readonly buffer B3 { Gaussian gaussians[]; };
// [phase][node]: displacement; zero at the rest phase.
layout(binding = 4) readonly buffer B4 { vec4 motion_grid[]; };
// [Gaussian][basis function]
layout(binding = 5) readonly buffer B5 { vec4 own_motion[]; };
// [phase][basis function]
layout(binding = 6) readonly buffer B6 { float motion_basis[]; };
// [phase][view]: index of the image, or -1.
layout(binding = 7) readonly buffer B7 { int image_of_view[]; };
// [phase][view][Gaussian], from `first_phase` on.
layout(binding = 8) writeonly buffer B8 { Splat splats[]; };
layout(binding = 9) writeonly buffer B9 { int image_of_splat[]; };
#include "inc/gaussian_motion.glsl"

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= push.n_gaussians) return;
    uint phase = push.first_phase + gl_WorkGroupID.y / gaussian_setup.n_views;
    uint view = gl_WorkGroupID.y % gaussian_setup.n_views;
    Gaussian g = gaussians[i];
    uint at = gl_WorkGroupID.y * push.n_gaussians + i;
    int image = image_of_view[phase * gaussian_setup.n_views + view];
    GaussianView seen_by = gaussian_views[max(image, 0)];
    vec3 x = position_at(i, g.position, phase, seen_by.du.w);
    splats[at] = project(g, x, seen_by, gaussian_setup).splat;
    image_of_splat[at] = image;
}
