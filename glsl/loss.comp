#version 450
#extension GL_GOOGLE_include_directive : require
// Photometric loss and its gradient: one number per ray and field, since the march is linear.
//   absolute target: both fields share the residual S + D - y (paper, L_p).
//   temporal target: D fits the integral above the pixel's still background, S fits what D leaves of y.
//   ray_gradient[ray] = dL/dS, dL/dD;  ray_loss[ray] = L_p share, its dynamic part, occlusion, (S + D - y)^2.
// Invariant: both gradients carry 2 / rays, so a batch is a mean.
#include "inc/layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_ray; uint n_rays; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { Ray rays[]; };
layout(binding = 2) readonly buffer B2 { RayOut ray_out[]; };
layout(binding = 3) writeonly buffer B3 { vec2 ray_gradient[]; };
layout(binding = 4) writeonly buffer B4 { vec4 ray_loss[]; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= push.n_rays) return;
    uint r = push.first_ray + i;
    RayOut seen = ray_out[r];
    float scale = 1.0 / float(setup.n_rays);
    float total = seen.static_integral + seen.dynamic_integral - rays[r].target;
    float dynamic_residual = setup.temporal_target != 0u ? seen.dynamic_integral - rays[r].temporal_target : total;
    ray_gradient[r] = 2.0 * scale * vec2(setup.static_weight * total, setup.dynamic_weight * dynamic_residual);
    float dynamic_loss = scale * setup.dynamic_weight * dynamic_residual * dynamic_residual;
    float data = scale * setup.static_weight * total * total + (setup.temporal_target != 0u ? dynamic_loss : 0.0);
    ray_loss[r] = vec4(data, dynamic_loss, seen.occlusion, scale * total * total);
}
