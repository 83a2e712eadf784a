#version 450
#extension GL_GOOGLE_include_directive : require
// Counts the live dynamic samples of each ray of a chunk: lane_counts[ray][lane].
#include "inc/march_samples.glsl"
layout(binding = 4) writeonly buffer B4 { uint lane_counts[]; };

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
    lane_counts[r * gl_WorkGroupSize.x + lane] = live;
}
