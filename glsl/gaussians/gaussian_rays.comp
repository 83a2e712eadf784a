#version 450
#extension GL_GOOGLE_include_directive : require
// Exact line integrals of the dynamic field's Gaussians in closed form, and the maximum attenuation along each ray. Along any
// ray the field is a sum of one-dimensional Gaussians. One workgroup per tile of 8 x 8 pixels of an image, one invocation per
// ray.
//   ray_out[ray].dynamic_integral; with_maxima: also dynamic_max and total_max
// The static field's maximum is that of march_fwd in ray_out. Reference implementation: reference::blobs.
#include "inc/operands.glsl"
#include "inc/layout.glsl"
#include "inc/gaussian_layout.glsl"
#include "inc/softplus.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/reduce.glsl"
layout(constant_id = 1) const uint with_maxima = 0u;
layout(push_constant) uniform Push { uint n_rays; uint image_width; uint first_blob; uint n_blobs; } push;
layout(binding = 0) SETUP B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { Ray rays[]; };
layout(binding = 2) readonly buffer B2 { Blob blobs[]; };
READ_VEC4(3, B3, static_params);
layout(binding = 4) buffer B4 { RayOut ray_out[]; };
#include "inc/tensor_vm.glsl"
#include "inc/blobs.glsl"
#include "inc/blob_rays.glsl"

// Maximum number of Gaussians of a ray among which its maximum is searched; the strongest are kept.
const uint MAX_PEAKS = 32u;
// Number of steps of the iteration from a Gaussian's peak towards the peak of the sum.
const uint CLIMBS = 4u;
const float TWO_PI = 6.28318530718;

// Gaussians along the ray: peak_height exp(-peak_steepness (depth - peak_at)^2 / 2).
float peak_at[MAX_PEAKS];
float peak_steepness[MAX_PEAKS];
float peak_height[MAX_PEAKS];
uint n_peaks = 0u;

void keep_peak(float at, float steepness, float height) {
    uint slot = n_peaks;
    if (slot == MAX_PEAKS) {
        slot = 0u;
        for (uint i = 1u; i < MAX_PEAKS; i++)
            if (peak_height[i] < peak_height[slot]) slot = i;
        if (height <= peak_height[slot]) return;
    } else {
        n_peaks++;
    }
    peak_at[slot] = at;
    peak_steepness[slot] = steepness;
    peak_height[slot] = height;
}

// Attenuation of the kept Gaussians at a depth, and the depth of the iteration's next step.
float sum_at(float depth, out float next) {
    float sum = 0.0, pull = 0.0, weight = 0.0;
    for (uint i = 0u; i < n_peaks; i++) {
        float d = depth - peak_at[i];
        float value = peak_height[i] * exp(-0.5 * peak_steepness[i] * d * d);
        sum += value;
        pull += value * peak_steepness[i] * peak_at[i];
        weight += value * peak_steepness[i];
    }
    next = weight > 0.0 ? pull / weight : depth;
    return sum;
}

void main() {
    TileRay own = ray_of_lane();
    Tile tile = tile_of(own.ray);
    uint r = own.index;
    float integral = 0.0;
    for (uint begin = 0u; begin < push.n_blobs; begin += 64u) {
        uint at = begin + gl_LocalInvocationID.x;
        mark_near(at < push.n_blobs && is_near(blobs[push.first_blob + min(at, push.n_blobs - 1u)], tile));
        for (uint word = 0u; word < 2u; word++) {
            for (uint bits = near_blobs[word]; bits != 0u; bits &= bits - 1u) {
                Profile p = profile_of(blobs[push.first_blob + begin + 32u * word + uint(findLSB(bits))], own.ray);
                if (p.height == 0.0) continue;
                integral += p.height * sqrt(TWO_PI / p.steepness) * own.ray.norm;
                if (with_maxima != 0u) keep_peak(p.at, p.steepness, p.height);
            }
        }
    }
    if (!own.wanted) return;
    ray_out[r].dynamic_integral = integral;
    if (with_maxima == 0u) return;
    float dynamic_max = 0.0;
    float total_max = ray_out[r].static_max;
    for (uint i = 0u; i < n_peaks; i++) {
        float depth = peak_at[i], next;
        for (uint k = 0u; k < CLIMBS; k++) {
            sum_at(depth, next);
            depth = next;
        }
        float value = sum_at(depth, next);
        dynamic_max = max(dynamic_max, value);
        vec3 x = own.ray.anchor + depth * own.ray.direction;
        total_max = max(total_max, value + (static_inside(x) ? static_attenuation(x) : 0.0));
    }
    ray_out[r].dynamic_max = dynamic_max;
    ray_out[r].total_max = total_max;
}
