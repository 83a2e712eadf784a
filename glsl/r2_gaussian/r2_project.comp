#version 450
#extension GL_GOOGLE_include_directive : require
// Projects each Gaussian of R2-Gaussian into the view that its set uses in this iteration. One invocation per Gaussian.
#include "inc/r2.glsl"
#include "inc/r2_chord.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_gaussians; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { R2Setup r2_setup; };
// View of each image.
layout(binding = 2) readonly buffer B2 { GaussianView gaussian_views[]; };
layout(binding = 3) readonly buffer B3 { R2Gaussian r2_gaussians[]; };
// [iteration][set]
layout(binding = 4) readonly buffer B4 { PictureTurn picture_turns[]; };
layout(binding = 5) readonly buffer B5 { uint gaussian_step; };
layout(binding = 6) writeonly buffer B6 { Splat splats[]; };
// Picture of each splat; there is one picture per set.
layout(binding = 7) writeonly buffer B7 { int image_of_splat[]; };

void main() {
    uint i = invocation();
    if (i >= push.n_gaussians) return;
    R2Gaussian g = r2_gaussians[i];
    PictureTurn turn = picture_turns[gaussian_step * r2_setup.n_sets + g.set];
    GaussianView view = gaussian_views[turn.image];
    R2Projection p = project_r2(g, view, gaussian_setup);
    if (r2_setup.exact != 0u && p.at.depth > 0.0) p.splat.half_box = chord_box(p, view, gaussian_setup);
    splats[i] = p.splat;
    image_of_splat[i] = int(g.set);
}
