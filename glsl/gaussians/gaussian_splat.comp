#version 450
#extension GL_GOOGLE_include_directive : require
// Images of Gaussians: each Gaussian is added to the pixels of its box. An image is a plain sum and needs no sorting. The sums
// are integers in fixed point, so their order does not matter and runs are bit-identical. One invocation per splat, or several
// that share one. Each processes its own pixels, so that no reduction over lanes is necessary.
#include "inc/gaussian.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/splat_lanes.glsl"
layout(push_constant) uniform Push { uint n_splats; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) readonly buffer B1 { Splat splats[]; };
layout(binding = 2) readonly buffer B2 { int image_of_splat[]; };
// [image][row][column] in fixed point; image_stride numbers per image.
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
    // A single loop over the box replaces two nested loops, so that lanes with different boxes wait for each other only once.
    for (Walk walk = walk_from(box); walk.k < n; walk_on(walk, box)) {
        float value = amplitude * falloff(half_log2, vec2(walk.at) - s.mean);
        uint pixel = uint(walk.at.y) * gaussian_setup.width + uint(walk.at.x);
        atomicAdd(splat_images[first + pixel], int(roundEven(value)));
    }
}
