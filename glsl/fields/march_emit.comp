#version 450
#extension GL_GOOGLE_include_directive : require
// Writes the live samples of the dynamic field of a chunk in the order of rays and depths.
//   sample_points[s] = (x, y, z, path length);  sample_rays[s]: index of the ray in the batch, and whether the sample is near.
#include "inc/march_samples.glsl"
#include "inc/sample_rays.glsl"
layout(binding = 3) readonly buffer B3 { LiveSamples live; };
layout(binding = 4) readonly buffer B4 { uint lane_masks[]; };
layout(binding = 5) readonly buffer B5 { uint lane_offsets[]; };
layout(binding = 6) readonly buffer B6 { uint ray_start[]; };
layout(binding = 7) writeonly buffer B7 { vec4 sample_points[]; };
layout(binding = 8) writeonly buffer B8 { uint sample_rays[]; };

// Path length of a ray from its first depth to the end of the sample at `depth`, whose own path length is `dl`.
float path_so_far(Ray ray, float depth, float dl) {
    return (depth - dynamic_depth(0u, ray)) * ray.norm + dl;
}

// Path length up to which the samples of all rays count as near. It is computed from the last ray of the batch.
float near_path() {
    Ray last = rays[setup.n_rays - 1u];
    return setup.occlusion_share * path_so_far(last, dynamic_depth(setup.n_dynamic_samples - 1u, last), 1e-10 * last.norm);
}

void main() {
    if (live.count == 0u || !has_ray()) return;
    uint lane = ray_lane();
    uint r = push.first_ray + ray_of_chunk();
    uint slot = ray_start[ray_of_chunk()] + lane_offsets[r * ray_lanes + lane];
    for (uint word = 0u; word < mask_words(); word++) {
        uint mask = lane_masks[(r * ray_lanes + lane) * mask_words() + word];
        if (mask == 0u) continue;
        Ray ray = rays[r];
        float near_end = setup.occlusion_share > 0.0 ? near_path() : 0.0;
        for (; mask != 0u; mask &= mask - 1u) {
            uint k = lane * run_length() + 32u * word + uint(findLSB(mask));
            float depth = dynamic_depth(k, ray);
            float dl = path_length(depth, k, setup.n_dynamic_samples, setup.dynamic_near, setup.dynamic_far,
                                   setup.jitter, setup.seed, state.step, depth_stream(ray), ray.norm);
            sample_points[slot] = vec4(ray.anchor + depth * ray.direction, dl);
            bool near = setup.occlusion_share > 0.0 ? path_so_far(ray, depth, dl) < near_end : depth < setup.occlusion_depth;
            sample_rays[slot] = sample_ray(r, near);
            slot++;
        }
    }
}
