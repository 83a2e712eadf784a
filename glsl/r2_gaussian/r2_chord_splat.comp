#version 450
#extension GL_GOOGLE_include_directive : require
// Images of Gaussians as in gaussian_splat, but with the exact line integral along each pixel's own ray instead of the affine
// approximation.
#include "inc/r2.glsl"
#include "inc/r2_chord.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/splat_lanes.glsl"
layout(push_constant) uniform Push { uint n_gaussians; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { R2Setup r2_setup; };
layout(binding = 2) readonly buffer B2 { GaussianView gaussian_views[]; };
layout(binding = 3) readonly buffer B3 { R2Gaussian r2_gaussians[]; };
layout(binding = 4) readonly buffer B4 { PictureTurn picture_turns[]; };
layout(binding = 5) readonly buffer B5 { uint gaussian_step; };
layout(binding = 6) readonly buffer B6 { Splat splats[]; };
// [set][row][column] in fixed point; image_stride numbers per picture.
layout(binding = 7) buffer B7 { int splat_images[]; };

void main() {
    uint i = splat_index();
    if (i >= push.n_gaussians) return;
    R2Gaussian g = r2_gaussians[i];
    GaussianView view = gaussian_views[picture_turns[gaussian_step * r2_setup.n_sets + g.set].image];
    Splat s = splats[i];
    R2Sight sight = sight_of(g, s.mean, view, gaussian_setup);
    uint first = g.set * gaussian_setup.image_stride;
    ivec4 box = pixels_of(s, gaussian_setup);
    uint n = n_pixels(box);
    for (Walk walk = walk_from(box); walk.k < n; walk_on(walk, box)) {
        float value = gaussian_setup.fixed_point * chord_at(sight, view, vec2(walk.at) - s.mean).integral;
        uint pixel = uint(walk.at.y) * gaussian_setup.width + uint(walk.at.x);
        atomicAdd(splat_images[first + pixel], int(roundEven(value)));
    }
}
