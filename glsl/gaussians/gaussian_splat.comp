#version 450
#extension GL_GOOGLE_include_directive : require
// Images of Gaussians: each adds itself to the pixels of its box. An image is a plain sum, so there is no sorting; sums
// are integers of a fixed point, so their order does not matter and runs repeat bit by bit.
// One invocation per splat, or as many as share one; each walks its own pixels, so nothing is reduced across lanes.
#include "inc/gaussian.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/splat_lanes.glsl"
layout(push_constant) uniform Push { uint n_splats; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) readonly buffer B1 { Splat splats[]; };
layout(binding = 2) readonly buffer B2 { int image_of_splat[]; };
// [image][row][column], fixed point; an image takes image_stride numbers.
layout(binding = 3) buffer B3 { int splat_images[]; };

void main() {
    uint i = splat_index();
    if (i >= push.n_splats || image_of_splat[i] < 0) return;
    Splat s = splats[i];
    uint first = uint(image_of_splat[i]) * gaussian_setup.image_stride;
    vec3 half_log2 = -HALF_LOG2_E * s.conic;
    float amplitude = s.amplitude * gaussian_setup.fixed_point;
    ivec4 box = pixels_of(s, gaussian_setup);
    uint n = n_pixels(box);
    // One loop over the box instead of two nested ones: lanes of different boxes wait for each other once.
    for (Walk walk = walk_from(box); walk.k < n; walk_on(walk, box)) {
        float value = amplitude * falloff(half_log2, vec2(walk.at) - s.mean);
        uint pixel = uint(walk.at.y) * gaussian_setup.width + uint(walk.at.x);
        atomicAdd(splat_images[first + pixel], int(roundEven(value)));
    }
}
