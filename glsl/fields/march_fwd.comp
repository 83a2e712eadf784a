#version 450
#extension GL_GOOGLE_include_directive : require
// Line integrals of rays and, if requested, maxima along them. Training uses march_loss instead.
//   ray_out[ray] = integrals of sigma_l and sigma_s, occlusion term, and maxima along the ray or 0.
#include "inc/layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
#include "inc/softplus.glsl"
#include "inc/sample_rays.glsl"
#include "inc/operands.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_ray; uint n_rays; uint with_maxima; } push;
layout(binding = 0) SETUP B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Ray rays[]; };
layout(binding = 3) readonly buffer B3 { uint ray_start[]; };
layout(binding = 4) readonly buffer B4 { vec4 sample_points[]; };
layout(binding = 5) readonly buffer B5 { uint sample_rays[]; };
layout(binding = 6) readonly buffer B6 { vec2 sample_sigma[]; };
READ_VEC4(7, B7, static_params);
layout(binding = 8) writeonly buffer B8 { RayOut ray_out[]; };
#include "inc/tensor_vm.glsl"
#include "inc/march_rays.glsl"
#include "inc/static_samples.glsl"

REDUCE(vec4, ray_sum, sum_scratch, SUM_OF, ray_lanes)
REDUCE(float, ray_max, max_scratch, max, ray_lanes)

void main() {
    uint lane = ray_lane();
    uint r = push.first_ray + ray_of_chunk();
    Ray ray = rays[r];
    float static_sum = 0.0;
    float static_max = 0.0;
    for (uint k = lane; k < setup.n_static_samples; k += ray_lanes) {
        StaticSample here = static_sample(k, ray);
        if (static_inside(here.x)) {
            float sigma = static_attenuation(here.x);
            static_sum += sigma * here.path_length;
            static_max = max(static_max, sigma);
        }
    }
    float dynamic_sum = 0.0;
    float occlusion = 0.0;
    float dynamic_max = 0.0;
    float total_max = 0.0;
    uint end = ray_start[ray_of_chunk() + 1u];
    for (uint s = ray_start[ray_of_chunk()] + lane; s < end; s += ray_lanes) {
        vec4 point = sample_points[s];
        float sigma = sample_sigma[s].x;
        dynamic_sum += sigma * point.w;
        if (is_near(sample_rays[s])) occlusion += sigma * point.w;
        if (push.with_maxima == 0u) continue;
        dynamic_max = max(dynamic_max, sigma);
        total_max = max(total_max, sigma + (static_inside(point.xyz) ? static_attenuation(point.xyz) : 0.0));
    }
    vec4 sums = ray_sum(vec4(static_sum, dynamic_sum, occlusion, 0.0));
    RayOut result = RayOut(sums.x, sums.y, sums.z, 0.0, 0.0, 0.0);
    if (push.with_maxima != 0u) {
        result.static_max = ray_max(static_max);
        result.dynamic_max = ray_max(dynamic_max);
        result.total_max = max(ray_max(total_max), result.static_max);
    }
    if (lane == 0u && has_ray()) ray_out[r] = result;
}
