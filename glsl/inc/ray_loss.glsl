// Photometric loss of a ray and its gradient, which is one number per ray and field, because the march is linear.
//   absolute target: both fields have the residual S + D - y (paper, L_p).
//   temporal target: the target of D is an interval, the bounds of the integral above the pixel's static background; outside
//     the interval the residual is the distance from the nearer bound. S fits y - D.
// Each term is a mean over the rays that contribute to it. The including file must declare `setup` and include
// inc/static_rays.glsl.

struct RayLoss {
    vec2 gradient;   // derivatives dL/dS and dL/dD
    vec4 terms;      // contribution to L_p, its dynamic part, occlusion, (S + D - y)^2
};

// Charbonnier loss: r^2 near 0, linear beyond robust_scale, so that thick vessels do not dominate thin ones. Returns the value
// and half its derivative.
vec2 robust_square(float r) {
    if (setup.robust_scale == 0.0) return vec2(r * r, r);
    float s2 = setup.robust_scale * setup.robust_scale;
    float root = sqrt(1.0 + r * r / s2);
    return vec2(2.0 * s2 * (root - 1.0), r / root);
}

RayLoss loss_of(uint r, Ray ray, RayOut seen) {
    bool temporal = setup.temporal_target != 0u;
    float mean_scale = skips_static(r) ? 0.0 : 1.0 / float(n_static_rays());
    float static_scale = setup.static_weight * mean_scale;
    float total = seen.static_integral + seen.dynamic_integral - ray.target;
    float dynamic_scale = setup.dynamic_weight / float(setup.n_rays);
    float d = seen.dynamic_integral;
    float dynamic_residual = temporal ? d - clamp(d, ray.temporal_low, ray.temporal_high) : total;
    vec2 robust = robust_square(dynamic_residual);
    float dynamic_loss = dynamic_scale * robust.x;
    float data = static_scale * total * total + (temporal ? dynamic_loss : 0.0);
    return RayLoss(2.0 * vec2(static_scale * total, dynamic_scale * robust.y),
                   vec4(data, dynamic_loss, seen.occlusion, mean_scale * total * total));
}
