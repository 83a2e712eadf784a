#version 450
#extension GL_GOOGLE_include_directive : require
// Writes the live dynamic samples of a chunk, in ray and depth order.
//   sample_points[s] = (x, y, z, path length);  sample_rays[s] = ray of the batch.
//   Near samples subject to occlusion minimisation carry the top bit of sample_rays.
#include "inc/march_samples.glsl"
layout(binding = 4) readonly buffer B4 { uint lane_offsets[]; };
layout(binding = 5) readonly buffer B5 { uint live[]; };
layout(binding = 6) writeonly buffer B6 { vec4 sample_points[]; };
layout(binding = 7) writeonly buffer B7 { uint sample_rays[]; };
layout(binding = 9) readonly buffer B9 { uint ray_start[]; };

void main() {
    if (live[0] == 0u) return;
    uint lane = gl_LocalInvocationID.x;
    uint r = gl_WorkGroupID.x;
    Ray ray = rays[push.first_ray + r];
    uint begin = lane * run_length();
    uint end = min(begin + run_length(), setup.n_dynamic_samples);
    uint slot = ray_start[r] + lane_offsets[r * gl_WorkGroupSize.x + lane];
    for (uint k = begin; k < end; k++) {
        float depth = dynamic_depth(k, ray);
        vec3 x = ray.anchor + depth * ray.direction;
        if (!sample_lives(x, ray.phase)) continue;
        float dl = path_length(depth, k, setup.n_dynamic_samples, setup.dynamic_near, setup.dynamic_far,
                               setup.jitter, setup.seed, state[0], depth_stream(ray), ray.norm);
        sample_points[slot] = vec4(x, dl);
        sample_rays[slot] = (push.first_ray + r) | (depth < setup.occlusion_depth ? 0x80000000u : 0u);
        slot++;
    }
}
