#version 450
#extension GL_GOOGLE_include_directive : require
// Losses of two networks whose attenuations add up (NeRF-CA), and their gradients at each sample. One workgroup per ray. With
// path lengths dl, N rays, K depths per ray and the line integrals S and D of the static and the dynamic field:
//   photometric    mean over rays of w (S + D - y)^2, w = 1 + change_weight * change
//   favour static  mean over rays and depths of H(b) = -b ln b - (1 - b) ln(1 - b), b = sigma_s / (sigma_l + sigma_s + e)
//   ray entropy    mean over rays of -sum p ln(p + e), p = sigma_s dl / D, for rays whose D or change is above its threshold
//   near           mean over rays of the sum of sigma_s dl over near samples
//   static size    sum over rays and samples of sigma_l dl + (sigma_l dl)^2
//   static_network_gradient[s] = dL/d sigma_l;  sigma_gradient[s] = dL/d sigma_s;
//   ray_loss[ray] = (photometric, photometric, near, unweighted (S + D - y)^2);
//   ray_regularisers[ray] = (favour static, ray entropy, static size), without the weights of the schedule.
#include "inc/layout.glsl"
#include "inc/sample_rays.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_ray; uint n_rays; } push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Schedule schedule[]; };
layout(binding = 3) readonly buffer B3 { Ray rays[]; };
layout(binding = 4) readonly buffer B4 { uint ray_start[]; };
layout(binding = 5) readonly buffer B5 { vec4 sample_points[]; };
layout(binding = 6) readonly buffer B6 { uint sample_rays[]; };
layout(binding = 7) readonly buffer B7 { vec2 sample_sigma[]; };
layout(binding = 8) readonly buffer B8 { vec2 static_sigma[]; };
layout(binding = 9) readonly buffer B9 { RayOut ray_out[]; };
layout(binding = 10) writeonly buffer B10 { float sigma_gradient[]; };
layout(binding = 11) writeonly buffer B11 { float static_network_gradient[]; };
layout(binding = 12) writeonly buffer B12 { vec4 ray_loss[]; };
layout(binding = 13) writeonly buffer B13 { vec4 ray_regularisers[]; };
#include "inc/reduce.glsl"

const float SMALL = 1e-10;       // e
const float SMALLEST = 1e-19;    // minimum of a share, and minimum of D as a divisor
const float SERIES = 1e-3;       // threshold of a share below which the series is more accurate than the logarithm

// Computes ln(a), where a + rest = 1. Near 1 the error of the logarithm may be 2^-21, and that of a itself 2^-24. Both are
// larger than the entropy of a faint field.
float log_share(float a, float rest) {
    return rest < SERIES ? -rest - 0.5 * rest * rest : log(a);
}

// Entropy of the shares of both fields, and its derivatives with respect to sigma_l and sigma_s.
vec3 share_entropy(float of_static, float of_dynamic) {
    float sum = of_static + of_dynamic + SMALL;
    float b = max(of_dynamic / sum, SMALLEST);
    // This is 1 - b. The difference in f32 would be 0 where the static field is faint.
    float rest = max((of_static + SMALL) / sum, SMALLEST);
    bool clipped = b <= SMALLEST || rest <= SMALLEST;
    float log_b = log_share(b, rest);
    float log_rest = log_share(rest, b);
    float slope = clipped ? 0.0 : (log_rest - log_b) / sum;
    return vec3(-b * log_b - rest * log_rest, -slope * (of_dynamic / sum), slope * ((of_static + SMALL) / sum));
}

// Contribution of a sample with share p of a ray's integral to the entropy along the ray, and the negative of its derivative.
vec2 ray_entropy(float p) {
    float logarithm = log(p + SMALL);
    return vec2(-p * logarithm, logarithm + p / (p + SMALL));
}

void main() {
    uint r = push.first_ray + gl_WorkGroupID.x;
    uint first = ray_start[gl_WorkGroupID.x] + gl_LocalInvocationID.x;
    uint end = ray_start[gl_WorkGroupID.x + 1u];
    Schedule now = schedule[state.step];
    RayOut seen = ray_out[r];
    float change = rays[r].change;
    float integral = max(seen.dynamic_integral, SMALLEST);
    vec4 sums = vec4(0.0);
    for (uint s = first; s < end; s += gl_WorkGroupSize.x) {
        float dl = sample_points[s].w;
        float p = sample_sigma[s].x * dl / integral;
        vec2 entropy = ray_entropy(p);
        float of_static = static_sigma[s].x * dl;
        sums += vec4(share_entropy(static_sigma[s].x, sample_sigma[s].x).x, entropy.x, p * entropy.y, of_static + of_static * of_static);
    }
    sums = workgroup_sum(sums);
    float per_ray = 1.0 / float(setup.n_rays);
    float per_depth = per_ray / float(setup.n_dynamic_samples);
    float weight = 1.0 + setup.change_weight * change;
    float residual = seen.static_integral + seen.dynamic_integral - rays[r].target;
    bool entropy_counts = seen.dynamic_integral >= setup.min_integral || change > setup.min_change;
    float entropy_scale = entropy_counts ? per_ray : 0.0;
    // Where D is too small to be a divisor, the constant SMALLEST replaces it and has no derivative.
    float mean = seen.dynamic_integral > SMALLEST ? sums.z : 0.0;
    float photometric = 2.0 * per_ray * weight * residual;
    for (uint s = first; s < end; s += gl_WorkGroupSize.x) {
        float dl = sample_points[s].w;
        vec3 shares = share_entropy(static_sigma[s].x, sample_sigma[s].x);
        float of_static = static_sigma[s].x * dl;
        static_network_gradient[s] = photometric * dl + now.favour_static * per_depth * shares.y
                          + now.static_size * dl * (1.0 + 2.0 * of_static);
        float along = ray_entropy(sample_sigma[s].x * dl / integral).y - mean;
        sigma_gradient[s] = photometric * dl + now.favour_static * per_depth * shares.z
                          - now.ray_entropy * entropy_scale * dl / integral * along
                          + (is_near(sample_rays[s]) ? now.near_integral * per_ray * dl : 0.0);
    }
    if (gl_LocalInvocationID.x != 0u) return;
    float data = per_ray * weight * residual * residual;
    ray_loss[r] = vec4(data, data, per_ray * seen.occlusion, per_ray * residual * residual);
    ray_regularisers[r] = vec4(per_depth * sums.x, entropy_scale * sums.y, sums.w, 0.0);
}
