#version 450
#extension GL_GOOGLE_include_directive : require
// Moments of a picture from which the gradient of a Gaussian is computed, if the line integrals are those along the pixels' own
// rays. With h = dL/dD times the Gaussian's line integral at a pixel, they are the sums over its box of h, of h c and of h (c
// c^T + b b^T). Here c is the vector from the Gaussian's centre to the nearest point of the ray and b the ray's direction, both
// in the coordinates of the Gaussian's axes.
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
layout(binding = 7) readonly buffer B7 { float splat_image_gradient[]; };
// [Gaussian][3], as r2_voxel_moments: (h c, h), (xx, yy, zz, -), (xy, xz, yz, -).
layout(binding = 8) writeonly buffer B8 { vec4 splat_moments[]; };

void main() {
    if (push.n_gaussians == 0u) return;
    uint i = min(splat_index(), push.n_gaussians - 1u);
    R2Gaussian g = r2_gaussians[i];
    GaussianView view = gaussian_views[picture_turns[gaussian_step * r2_setup.n_sets + g.set].image];
    Splat s = splats[i];
    R2Sight sight = sight_of(g, s.mean, view, gaussian_setup);
    uint first = g.set * gaussian_setup.image_stride;
    ivec4 box = pixels_of(s, gaussian_setup);
    uint n = n_pixels(box);
    vec3 plain = vec3(0.0), linear = vec3(0.0), square = vec3(0.0), mixed = vec3(0.0);
    for (Walk walk = walk_from(box); walk.k < n; walk_on(walk, box)) {
        R2Chord chord = chord_at(sight, view, vec2(walk.at) - s.mean);
        uint pixel = uint(walk.at.y) * gaussian_setup.width + uint(walk.at.x);
        float h = splat_image_gradient[first + pixel] * chord.integral;
        vec3 c = chord.nearest, b = chord.direction;
        plain.x += h;
        linear += h * c;
        square += h * (c * c + b * b);
        mixed += h * vec3(c.x * c.y + b.x * b.y, c.x * c.z + b.x * b.z, c.y * c.z + b.y * b.z);
    }
    plain = splat_sum(plain);
    linear = splat_sum(linear);
    square = splat_sum(square);
    mixed = splat_sum(mixed);
    if (splat_lane() != 0u || splat_index() >= push.n_gaussians) return;
    splat_moments[3u * i] = vec4(linear, plain.x);
    splat_moments[3u * i + 1u] = vec4(square, 0.0);
    splat_moments[3u * i + 2u] = vec4(mixed, 0.0);
}
