#version 450
#extension GL_GOOGLE_include_directive : require
// First pass of SSIM between the picture x and the image y of each set: windowed sums of x, y, x^2, y^2 and x y along rows. One
// invocation per pixel (x) and set (y).
#include "inc/gaussian_layout.glsl"
#include "inc/picture_layout.glsl"
#include "inc/ssim.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { PictureSetup picture_setup; };
layout(binding = 2) readonly buffer B2 { PictureTurn picture_turns[]; };
layout(binding = 3) readonly buffer B3 { uint gaussian_step; };
// [set][pixel] in fixed point.
layout(binding = 4) readonly buffer B4 { int splat_images[]; };
// [image][pixel]
layout(binding = 5) readonly buffer B5 { float picture_targets[]; };
// [set][pixel]: sums of x, y, x^2, y^2.
layout(binding = 6) writeonly buffer B6 { vec4 ssim_row_sums[]; };
// [set][pixel]: sums of x y.
layout(binding = 7) writeonly buffer B7 { float ssim_row_products[]; };

void main() {
    uint p = gl_GlobalInvocationID.x, set = gl_WorkGroupID.y;
    uint stride = gaussian_setup.image_stride;
    int width = int(gaussian_setup.width);
    if (p >= gaussian_setup.width * gaussian_setup.height) return;
    uint picture = set * stride + p;
    uint image = picture_turns[gaussian_step * picture_setup.n_sets + set].image * stride + p;
    int column = int(p) % width;
    vec4 sums = vec4(0.0);
    float product = 0.0;
    for (int k = max(-SSIM_REACH, -column); k <= min(SSIM_REACH, width - 1 - column); k++) {
        float x = float(splat_images[picture + k]) / gaussian_setup.fixed_point;
        float y = picture_targets[image + k];
        float weight = SSIM_WINDOW[abs(k)];
        sums += weight * vec4(x, y, x * x, y * y);
        product += weight * x * y;
    }
    ssim_row_sums[picture] = sums;
    ssim_row_products[picture] = product;
}
