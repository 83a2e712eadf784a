#version 450
#extension GL_GOOGLE_include_directive : require
// Third pass of SSIM: windowed sums of the gradient factors along rows. With zeros outside the image, the window's operator is
// its own adjoint. One invocation per pixel (x) and set (y).
#include "inc/gaussian_layout.glsl"
#include "inc/ssim.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
// [set][pixel]: P, Q, T and a number that is not used.
layout(binding = 1) readonly buffer B1 { vec4 ssim_factors[]; };
// [set][pixel]: sums of P, Q and T, followed by 0.
layout(binding = 2) writeonly buffer B2 { vec4 ssim_row_factors[]; };

void main() {
    uint p = gl_GlobalInvocationID.x, set = gl_WorkGroupID.y;
    int width = int(gaussian_setup.width);
    if (p >= gaussian_setup.width * gaussian_setup.height) return;
    uint picture = set * gaussian_setup.image_stride + p;
    int column = int(p) % width;
    vec3 sums = vec3(0.0);
    for (int k = max(-SSIM_REACH, -column); k <= min(SSIM_REACH, width - 1 - column); k++)
        sums += SSIM_WINDOW[abs(k)] * ssim_factors[picture + k].xyz;
    ssim_row_factors[picture] = vec4(sums, 0.0);
}
