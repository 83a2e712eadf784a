#version 450
#extension GL_GOOGLE_include_directive : require
// Line integrals of a batch, their squared residuals, and the gradient of the mean squared residual. One workgroup per ray.
#include "inc/layout.glsl"
#include "inc/sax_layout.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
#include "inc/reduce.glsl"
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint first_loss; } push;
layout(binding = 0) uniform B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { Ray rays[]; };
layout(binding = 2) readonly buffer B2 { vec4 sax_points[]; };
layout(binding = 3) readonly buffer B3 { float sax_sigma[]; };
layout(binding = 4) writeonly buffer B4 { float sax_ray_gradient[]; };
layout(binding = 5) writeonly buffer B5 { float sax_losses[]; };  // [field][ray]

void main() {
    uint r = workgroup(), n = sax_setup.n_samples;
    if (r >= sax_setup.n_rays) return;
    float sum = 0.0;
    for (uint k = gl_LocalInvocationID.x; k < n; k += gl_WorkGroupSize.x)
        sum += sax_sigma[r * n + k] * sax_points[r * n + k].w;
    float integral = workgroup_sum(sum);
    if (gl_LocalInvocationID.x != 0u) return;
    float residual = integral - rays[r].target;
    sax_ray_gradient[r] = 2.0 * residual / float(sax_setup.n_rays);
    sax_losses[push.first_loss + r] = residual * residual / float(sax_setup.n_rays);
}
