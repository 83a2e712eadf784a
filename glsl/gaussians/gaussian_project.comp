#version 450
#extension GL_GOOGLE_include_directive : require
// Projects every Gaussian of each phase's set into every view. One invocation per Gaussian (x) and view (y).
#include "inc/gaussian.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_gaussians; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) readonly buffer B1 { GaussianView gaussian_views[]; };
layout(binding = 2) readonly buffer B2 { Gaussian gaussians[]; };
// [phase][view]: index of the image, or -1.
layout(binding = 3) readonly buffer B3 { int image_of_view[]; };
// [view][Gaussian]
layout(binding = 4) writeonly buffer B4 { Splat splats[]; };
// [view][Gaussian]: image of each splat, or -1.
layout(binding = 5) writeonly buffer B5 { int image_of_splat[]; };

void main() {
    uint i = gl_GlobalInvocationID.x, view = gl_WorkGroupID.y;
    if (i >= push.n_gaussians) return;
    Gaussian g = gaussians[i];
    int image = image_of_view[g.phase * gaussian_setup.n_views + view];
    splats[view * push.n_gaussians + i] = project(g, g.position, gaussian_views[max(image, 0)], gaussian_setup).splat;
    image_of_splat[view * push.n_gaussians + i] = image;
}
