#version 450
#extension GL_GOOGLE_include_directive : require
// Residuals of consecutive images in groups of four pixels. The loss is zero where the static background y - D is within its
// bounds, with D the image of the dynamic field. Elsewhere the residual r = D - bound, times the weight w that follows from the
// pixel's noise, has the Charbonnier loss
//   loss = sqrt((w r)^2 + bend^2) - bend
// The kernel reads the fixed-point sums and clears them for the next iteration.
#include "inc/gaussian.glsl"
// Number of groups of four pixels per invocation. It keeps the number of partial sums small.
#ifndef QUADS
#define QUADS 8u
#endif
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/reduce.glsl"
layout(push_constant) uniform Push { uint first_quad; uint n_quads; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) buffer B1 { ivec4 splat_images[]; };
// [image][group of four pixels]: lower and upper bound of D.
layout(binding = 2) readonly buffer B2 { vec4 bound_low[]; };
layout(binding = 3) readonly buffer B3 { vec4 bound_high[]; };
// [image][group of four pixels]: weight of each pixel.
layout(binding = 4) readonly buffer B4 { vec4 pixel_weight[]; };
// [image][group of four pixels]: dL/dD.
layout(binding = 5) writeonly buffer B5 { vec4 splat_image_gradient[]; };
// Partial sum of the loss of each workgroup.
layout(binding = 6) writeonly buffer B6 { float gaussian_loss_parts[]; };

void main() {
    float loss = 0.0;
    uint first = gl_WorkGroupID.x * QUADS * gl_WorkGroupSize.x + gl_LocalInvocationID.x;
    for (uint k = 0u; k < QUADS; k++) {
        uint quad = first + k * gl_WorkGroupSize.x;
        if (quad >= push.n_quads) break;
        uint i = push.first_quad + quad;
        vec4 d = vec4(splat_images[i]) / gaussian_setup.fixed_point;
        splat_images[i] = ivec4(0);
        vec4 w = pixel_weight[i];
        vec4 r = w * (d - clamp(d, bound_low[i], bound_high[i]));
        vec4 root = sqrt(r * r + gaussian_setup.bend * gaussian_setup.bend);
        splat_image_gradient[i] = gaussian_setup.loss_weight * w * r / root;
        // This form of root - bend has no cancellation.
        loss += gaussian_setup.loss_weight * dot(r * r / (root + gaussian_setup.bend), vec4(1.0));
    }
    float total = workgroup_sum(loss);
    if (gl_LocalInvocationID.x == 0u) gaussian_loss_parts[gl_WorkGroupID.x] = total;
}
