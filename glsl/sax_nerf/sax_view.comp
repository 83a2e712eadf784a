#version 450
#extension GL_GOOGLE_include_directive : require
// Line integrals and maxima along the rays of a view through the single field. One workgroup per ray.
#include "inc/layout.glsl"
#include "inc/sax_layout.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
#include "inc/reduce.glsl"
layout(push_constant) uniform Push { uint first_ray; uint n_rays; } push;
layout(binding = 0) uniform B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { vec4 sax_points[]; };
layout(binding = 2) readonly buffer B2 { float sax_sigma[]; };
layout(binding = 3) writeonly buffer B3 { RayOut ray_out[]; };

void main() {
    uint r = workgroup(), n = sax_setup.n_samples;
    if (r >= push.n_rays) return;
    float sum = 0.0, largest = 0.0;
    for (uint k = gl_LocalInvocationID.x; k < n; k += gl_WorkGroupSize.x) {
        sum += sax_sigma[r * n + k] * sax_points[r * n + k].w;
        largest = max(largest, sax_sigma[r * n + k]);
    }
    RayOut seen;
    seen.static_integral = 0.0;
    seen.dynamic_integral = workgroup_sum(sum);
    seen.occlusion = 0.0;
    seen.static_max = 0.0;
    seen.dynamic_max = workgroup_max(largest);
    seen.total_max = seen.dynamic_max;
    if (gl_LocalInvocationID.x == 0u) ray_out[push.first_ray + r] = seen;
}
