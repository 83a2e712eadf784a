#version 450
#extension GL_GOOGLE_include_directive : require
// Counts the live dynamic samples of each ray of a chunk.
//   lane_offsets[ray][lane] = samples of the lanes before;  ray_counts[ray] = samples of the ray.
#include "inc/march_samples.glsl"
layout(binding = 4) writeonly buffer B4 { uint lane_offsets[]; };
layout(binding = 5) writeonly buffer B5 { uint ray_counts[]; };

shared uint counts[gl_WorkGroupSize.x];

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint r = gl_WorkGroupID.x;
    Ray ray = rays[push.first_ray + r];
    uint begin = lane * run_length();
    uint end = min(begin + run_length(), setup.n_dynamic_samples);
    uint live = 0u;
    for (uint k = begin; k < end; k++) {
        if (sample_lives(ray.anchor + dynamic_depth(k, ray) * ray.direction, ray.phase)) live++;
    }
    counts[lane] = live;
    barrier();
    uint before = 0u;
    for (uint l = 0u; l < lane; l++) before += counts[l];
    lane_offsets[r * gl_WorkGroupSize.x + lane] = before;
    if (lane == gl_WorkGroupSize.x - 1u) ray_counts[r] = before + live;
}
