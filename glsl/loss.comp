#version 450
#extension GL_GOOGLE_include_directive : require
// Photometric loss and its gradient: one number per ray and field, since the march is linear.
//   absolute target: both fields share the residual S + D - y (paper, L_p).
//   temporal target: D lies between the bounds of the integral above the pixel's still background (outside
//   them it is pulled to the nearer one), S fits what D leaves of y.
//   ray_gradient[ray] = dL/dS, dL/dD;  ray_loss[ray] = L_p share, its dynamic part, occlusion, (S + D - y)^2.
// Each term is a mean over the rays that take part in it.
#include "inc/layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_ray; uint n_rays; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { Ray rays[]; };
layout(binding = 2) readonly buffer B2 { RayOut ray_out[]; };
layout(binding = 3) writeonly buffer B3 { vec2 ray_gradient[]; };
layout(binding = 4) writeonly buffer B4 { vec4 ray_loss[]; };
#include "inc/static_rays.glsl"

// Charbonnier: r^2 near 0, linear beyond robust_scale, so that thick vessels do not drown thin ones.
// Value, and half its derivative.
vec2 robust_square(float r) {
    if (setup.robust_scale == 0.0) return vec2(r * r, r);
    float s2 = setup.robust_scale * setup.robust_scale;
    float root = sqrt(1.0 + r * r / s2);
    return vec2(2.0 * s2 * (root - 1.0), r / root);
}

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= push.n_rays) return;
    uint r = push.first_ray + i;
    RayOut seen = ray_out[r];
    bool temporal = setup.temporal_target != 0u;
    float mean_scale = skips_static(r) ? 0.0 : 1.0 / float(n_static_rays());
    float static_scale = setup.static_weight * mean_scale;
    float total = seen.static_integral + seen.dynamic_integral - rays[r].target;
    float dynamic_scale = setup.dynamic_weight / float(setup.n_rays);
    float d = seen.dynamic_integral;
    float dynamic_residual = temporal ? d - clamp(d, rays[r].temporal_low, rays[r].temporal_high) : total;
    vec2 robust = robust_square(dynamic_residual);
    ray_gradient[r] = 2.0 * vec2(static_scale * total, dynamic_scale * robust.y);
    float dynamic_loss = dynamic_scale * robust.x;
    float data = static_scale * total * total + (temporal ? dynamic_loss : 0.0);
    ray_loss[r] = vec4(data, dynamic_loss, seen.occlusion, mean_scale * total * total);
}
