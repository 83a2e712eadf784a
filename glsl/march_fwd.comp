#version 450
#extension GL_GOOGLE_include_directive : require
// Linear Beer-Lambert march (method, eq. of section 2.2): one workgroup per ray.
//   ray_out[ray] = integrals of sigma_l and sigma_s, occlusion term, maxima along the ray.
#include "inc/layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
#include "inc/softplus.glsl"
#include "inc/sample_rays.glsl"
#include "inc/operands.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(constant_id = 1) const uint with_maxima = 0u;
layout(push_constant) uniform Push { uint first_ray; uint n_rays; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Ray rays[]; };
layout(binding = 3) readonly buffer B3 { uint ray_start[]; };
layout(binding = 4) readonly buffer B4 { vec4 sample_points[]; };
layout(binding = 5) readonly buffer B5 { uint sample_rays[]; };
layout(binding = 6) readonly buffer B6 { vec2 sample_sigma[]; };
READ_VEC4(7, B7, static_params);
layout(binding = 8) writeonly buffer B8 { RayOut ray_out[]; };
#include "inc/tensor_vm.glsl"
#include "inc/reduce.glsl"
#include "inc/static_rays.glsl"

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint r = push.first_ray + gl_WorkGroupID.x;
    Ray ray = rays[r];
    uint stream = setup.per_ray_depths != 0u ? ray.id + 1u : 0u;
    float static_sum = 0.0;
    float static_max = 0.0;
    uint n_static = with_maxima == 0u && skips_static(r) ? 0u : setup.n_static_samples;
    for (uint k = lane; k < n_static; k += gl_WorkGroupSize.x) {
        float depth = depth_at(k, setup.n_static_samples, setup.static_near, setup.static_far, setup.jitter,
                               setup.seed, state.step, stream);
        vec3 x = ray.anchor + depth * ray.direction;
        if (static_inside(x)) {
            float sigma = static_attenuation(x);
            static_sum += sigma * path_length(depth, k, setup.n_static_samples, setup.static_near, setup.static_far, setup.jitter,
                                       setup.seed, state.step, stream, ray.norm);
            static_max = max(static_max, sigma);
        }
    }
    float dynamic_sum = 0.0;
    float occlusion = 0.0;
    float dynamic_max = 0.0;
    float total_max = 0.0;
    uint end = ray_start[gl_WorkGroupID.x + 1u];
    for (uint s = ray_start[gl_WorkGroupID.x] + lane; s < end; s += gl_WorkGroupSize.x) {
        vec4 point = sample_points[s];
        float sigma = sample_sigma[s].x;
        dynamic_sum += sigma * point.w;
        if (is_near(sample_rays[s])) occlusion += sigma * point.w;
        if (with_maxima != 0u) {
            dynamic_max = max(dynamic_max, sigma);
            total_max = max(total_max, sigma + (static_inside(point.xyz) ? static_attenuation(point.xyz) : 0.0));
        }
    }
    RayOut result;
    result.static_integral = workgroup_sum(static_sum);
    result.dynamic_integral = workgroup_sum(dynamic_sum);
    result.occlusion = workgroup_sum(occlusion);
    result.static_max = 0.0;
    result.dynamic_max = 0.0;
    result.total_max = 0.0;
    if (with_maxima != 0u) {
        result.static_max = workgroup_max(static_max);
        result.dynamic_max = workgroup_max(dynamic_max);
        result.total_max = max(workgroup_max(total_max), result.static_max);
    }
    if (lane == 0u) ray_out[r] = result;
}
