#version 450
#extension GL_GOOGLE_include_directive : require
// Second pass of SSIM, along columns: the SSIM value v of each pixel and the factors of its gradient
//   P = 2 m2 (A2 - A1) / (B1 B2) + 2 m1 v (1 / B2 - 1 / B1),  Q = -v / B2,  T = 2 A1 / (B1 B2)
// with A1 = 2 m1 m2 + C1, A2 = 2 s12 + C2, B1 = m1^2 + m2^2 + C1, B2 = s1 + s2 + C2, where the means m and the variances s are
// those of the window. The loss of each set is the mean of |x - y| + ssim_weight (1 - v). One invocation per pixel (x) and set
// (y).
#include "inc/gaussian_layout.glsl"
#include "inc/picture_layout.glsl"
#include "inc/ssim.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/reduce.glsl"
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { PictureSetup picture_setup; };
layout(binding = 2) readonly buffer B2 { PictureTurn picture_turns[]; };
layout(binding = 3) readonly buffer B3 { uint gaussian_step; };
layout(binding = 4) readonly buffer B4 { int splat_images[]; };
layout(binding = 5) readonly buffer B5 { float picture_targets[]; };
layout(binding = 6) readonly buffer B6 { vec4 ssim_row_sums[]; };
layout(binding = 7) readonly buffer B7 { float ssim_row_products[]; };
// [set][pixel]: P, Q, T and v.
layout(binding = 8) writeonly buffer B8 { vec4 ssim_factors[]; };
// Partial sum of the loss of each workgroup.
layout(binding = 9) writeonly buffer B9 { float gaussian_loss_parts[]; };

// Computes the loss of a pixel and writes its gradient factors for the next pass.
float compare(uint p, uint set) {
    uint stride = gaussian_setup.image_stride;
    int width = int(gaussian_setup.width), row = int(p) / width;
    uint picture = set * stride + p;
    vec4 sums = vec4(0.0);
    float product = 0.0;
    for (int k = max(-SSIM_REACH, -row); k <= min(SSIM_REACH, int(gaussian_setup.height) - 1 - row); k++) {
        float weight = SSIM_WINDOW[abs(k)];
        sums += weight * ssim_row_sums[picture + k * width];
        product += weight * ssim_row_products[picture + k * width];
    }
    float m1 = sums.x, m2 = sums.y;
    float a1 = 2.0 * m1 * m2 + SSIM_C1, a2 = 2.0 * (product - m1 * m2) + SSIM_C2;
    float b1 = m1 * m1 + m2 * m2 + SSIM_C1, b2 = sums.z - m1 * m1 + sums.w - m2 * m2 + SSIM_C2;
    float both = 1.0 / (b1 * b2);
    float v = a1 * a2 * both;
    ssim_factors[picture] =
        vec4(2.0 * m2 * (a2 - a1) * both + 2.0 * m1 * v * (1.0 / b2 - 1.0 / b1), -v / b2, 2.0 * a1 * both, v);
    float x = float(splat_images[picture]) / gaussian_setup.fixed_point;
    float y = picture_targets[picture_turns[gaussian_step * picture_setup.n_sets + set].image * stride + p];
    return abs(x - y) + picture_setup.ssim_weight * (1.0 - v);
}

void main() {
    uint p = gl_GlobalInvocationID.x, set = gl_WorkGroupID.y;
    uint n_pixels = gaussian_setup.width * gaussian_setup.height;
    float loss = p < n_pixels ? compare(p, set) : 0.0;
    float total = workgroup_sum(gaussian_setup.loss_weight / float(n_pixels) * loss);
    if (gl_LocalInvocationID.x == 0u) gaussian_loss_parts[set * gl_NumWorkGroups.x + gl_WorkGroupID.x] = total;
}
