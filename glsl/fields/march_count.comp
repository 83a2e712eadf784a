#version 450
#extension GL_GOOGLE_include_directive : require
// Finds and counts the live samples of the dynamic field on each ray of a chunk. Its output for a ray is at the ray's index in
// the batch.
//   lane_masks: one bit per depth, set for live samples;  lane_offsets[ray][lane]: live samples of the preceding lanes;
//   ray_counts[ray]: live samples of the ray.
#include "inc/march_samples.glsl"
layout(binding = 3) readonly buffer B3 { uint hull[]; };
layout(binding = 4) readonly buffer B4 { uint occupancy[]; };
layout(binding = 5) writeonly buffer B5 { uint lane_masks[]; };
layout(binding = 6) writeonly buffer B6 { uint lane_offsets[]; };
layout(binding = 7) writeonly buffer B7 { uint ray_counts[]; };
#include "inc/dynamic_box.glsl"
#include "inc/occupied.glsl"

PREFIX(live_before, counts, ray_lanes)

// Whether the dynamic field is evaluated at a point of a ray: it may exist there at one of the phases that the ray shows.
bool searched(vec3 x, Ray ray) {
    if (dynamic_inside(x, ray.phase) && occupied(x, ray.phase, state.step)) return true;
    if (ray.beyond_share == 0.0) return false;
    return dynamic_inside(x, ray.beyond) && occupied(x, ray.beyond, state.step);
}

void main() {
    uint lane = ray_lane();
    uint r = push.first_ray + ray_of_chunk();
    Ray ray = rays[r];
    uint begin = lane * run_length();
    uint end = has_ray() ? min(begin + run_length(), setup.n_dynamic_samples) : begin;
    uint live = 0u;
    for (uint word = 0u; word < mask_words(); word++) {
        uint mask = 0u;
        uint first = begin + 32u * word;
        for (uint k = first; k < min(first + 32u, end); k++) {
            vec3 x = ray.anchor + dynamic_depth(k, ray) * ray.direction;
            if (searched(x, ray)) mask |= 1u << (k - first);
        }
        if (has_ray()) lane_masks[(r * ray_lanes + lane) * mask_words() + word] = mask;
        live += bitCount(mask);
    }
    uint before = live_before(live);
    if (!has_ray()) return;
    lane_offsets[r * ray_lanes + lane] = before;
    if (lane == ray_lanes - 1u) ray_counts[r] = before + live;
}
