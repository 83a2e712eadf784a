#version 450
#extension GL_GOOGLE_include_directive : require
// Linear Beer-Lambert march where both fields are networks, which are evaluated at the same samples. One workgroup per ray.
//   ray_out[ray] = integrals of sigma_l and sigma_s, integral of sigma_s over near samples, and, if requested, maxima along the
//     ray.
#include "inc/layout.glsl"
#include "inc/sample_rays.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_ray; uint n_rays; uint with_maxima; } push;
layout(binding = 0) readonly buffer B0 { uint ray_start[]; };
layout(binding = 1) readonly buffer B1 { vec4 sample_points[]; };
layout(binding = 2) readonly buffer B2 { uint sample_rays[]; };
layout(binding = 3) readonly buffer B3 { vec2 sample_sigma[]; };
layout(binding = 4) readonly buffer B4 { vec2 static_sigma[]; };
layout(binding = 5) writeonly buffer B5 { RayOut ray_out[]; };
#include "inc/reduce.glsl"

void main() {
    vec4 integrals = vec4(0.0);
    vec3 largest = vec3(0.0);
    uint end = ray_start[gl_WorkGroupID.x + 1u];
    for (uint s = ray_start[gl_WorkGroupID.x] + gl_LocalInvocationID.x; s < end; s += gl_WorkGroupSize.x) {
        float of_static = static_sigma[s].x;
        float of_dynamic = sample_sigma[s].x;
        float near = is_near(sample_rays[s]) ? of_dynamic : 0.0;
        integrals += sample_points[s].w * vec4(of_static, of_dynamic, near, 0.0);
        largest = max(largest, vec3(of_static, of_dynamic, of_static + of_dynamic));
    }
    integrals = workgroup_sum(integrals);
    if (push.with_maxima != 0u) {
        largest = vec3(workgroup_max(largest.x), workgroup_max(largest.y), workgroup_max(largest.z));
    }
    if (gl_LocalInvocationID.x != 0u) return;
    ray_out[push.first_ray + gl_WorkGroupID.x] =
        RayOut(integrals.x, integrals.y, integrals.z, largest.x, largest.y, largest.z);
}
