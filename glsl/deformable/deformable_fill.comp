#version 450
#extension GL_GOOGLE_include_directive : require
// Multiplies the amplitude of each splat of the deformable set by the filling of its Gaussian at the time of the image. Moments,
// and with them all gradients, contain the filling from here on. One invocation per Gaussian (x) and per phase and view (y).
#include "inc/gaussian_layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_gaussians; uint first_phase; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) readonly buffer B1 { GaussianView gaussian_views[]; };
// [phase][view][Gaussian], from `first_phase` on: index of the image, or -1.
layout(binding = 2) readonly buffer B2 { int image_of_splat[]; };
// [Gaussian][phase]
layout(binding = 3) readonly buffer B3 { float filling[]; };
// [phase][view][Gaussian], from `first_phase` on.
layout(binding = 4) buffer B4 { Splat splats[]; };
#include "inc/filling.glsl"

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= push.n_gaussians) return;
    uint at = gl_WorkGroupID.y * push.n_gaussians + i;
    int image = image_of_splat[at];
    if (image < 0) return;
    uint phase = push.first_phase + gl_WorkGroupID.y / gaussian_setup.n_views;
    splats[at].amplitude *= filling_at(i, phase, gaussian_views[image].du.w);
}
