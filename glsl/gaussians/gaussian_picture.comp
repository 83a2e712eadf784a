#version 450
// A picture of Gaussians from its sums in fixed point, in front of what the image shows already. One invocation per pixel.
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_pixels; float unit; uint in_front; } push;
layout(binding = 0) readonly buffer B0 { int splat_images[]; };
layout(binding = 1) buffer B1 { float image[]; };

void main() {
    uint pixel = invocation();
    if (pixel >= push.n_pixels) return;
    // Rounded twice, as where the host does it: pictures do not depend on who asks.
    precise float integral = float(splat_images[pixel]) * push.unit;
    precise float both = integral + image[pixel];
    image[pixel] = push.in_front != 0u ? both : integral;
}
