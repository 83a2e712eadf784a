#version 450
// Converts the fixed-point sums of an image of Gaussians to line integrals, optionally added to the values already in the
// image. One invocation per pixel.
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_pixels; float unit; uint in_front; } push;
layout(binding = 0) readonly buffer B0 { int splat_images[]; };
layout(binding = 1) buffer B1 { float image[]; };

void main() {
    uint pixel = invocation();
    if (pixel >= push.n_pixels) return;
    // The result is rounded twice, as on the host, so that both compute identical images.
    precise float integral = float(splat_images[pixel]) * push.unit;
    precise float both = integral + image[pixel];
    image[pixel] = push.in_front != 0u ? both : integral;
}
