#version 450
#extension GL_GOOGLE_include_directive : require
// Last pass of SSIM, along columns, and the gradient of each set's loss with respect to its picture x with N pixels, compared
// with the image y:
//   (sign(x - y) - ssim_weight (G P + 2 x G Q + y G T)) / N
// where G is the window's operator. One invocation per pixel (x) and set (y).
#include "inc/gaussian_layout.glsl"
#include "inc/picture_layout.glsl"
#include "inc/ssim.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { PictureSetup picture_setup; };
layout(binding = 2) readonly buffer B2 { PictureTurn picture_turns[]; };
layout(binding = 3) readonly buffer B3 { uint gaussian_step; };
layout(binding = 4) readonly buffer B4 { int splat_images[]; };
layout(binding = 5) readonly buffer B5 { float picture_targets[]; };
layout(binding = 6) readonly buffer B6 { vec4 ssim_row_factors[]; };
// [set][pixel]
layout(binding = 7) writeonly buffer B7 { float splat_image_gradient[]; };

void main() {
    uint p = gl_GlobalInvocationID.x, set = gl_WorkGroupID.y;
    uint stride = gaussian_setup.image_stride, n_pixels = gaussian_setup.width * gaussian_setup.height;
    int width = int(gaussian_setup.width), row = int(p) / width;
    if (p >= n_pixels) return;
    uint picture = set * stride + p;
    vec3 sums = vec3(0.0);
    for (int k = max(-SSIM_REACH, -row); k <= min(SSIM_REACH, int(gaussian_setup.height) - 1 - row); k++)
        sums += SSIM_WINDOW[abs(k)] * ssim_row_factors[picture + k * width].xyz;
    float x = float(splat_images[picture]) / gaussian_setup.fixed_point;
    float y = picture_targets[picture_turns[gaussian_step * picture_setup.n_sets + set].image * stride + p];
    float likeness = sums.x + 2.0 * x * sums.y + y * sums.z;
    splat_image_gradient[picture] = (sign(x - y) - picture_setup.ssim_weight * likeness) / float(n_pixels);
}
