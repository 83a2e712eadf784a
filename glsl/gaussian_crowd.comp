#version 450
#extension GL_GOOGLE_include_directive : require
// The largest attenuation along each ray where far more Gaussians overlap than gaussian_rays keeps peaks of, and where
// there is no still field: their sum at regular depths, then uphill from the largest and from the strongest
// Gaussian, over all of them each time. One workgroup per tile of 8 x 8 pixels, one invocation per ray.
//   ray_out[ray].dynamic_max, total_max
// Twin: reference::blobs.
#include "inc/layout.glsl"
#include "inc/gaussian_layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/reduce.glsl"
layout(push_constant) uniform Push { uint n_rays; uint image_width; uint first_blob; uint n_blobs; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { Ray rays[]; };
layout(binding = 2) readonly buffer B2 { Blob blobs[]; };
layout(binding = 3) buffer B3 { RayOut ray_out[]; };
#include "inc/blobs.glsl"
#include "inc/blob_rays.glsl"

// Depths at which the sum is taken.
const uint DEPTHS = 128u;
// Steps towards the peak.
const uint CLIMBS = 6u;
// Standard deviations along the ray beyond which a Gaussian adds nothing that counts.
const float REACH = 4.0;

// What Gaussians add at a depth, and the same times where they peak. Here none counts as narrower than half a step, so that
// those between two depths are found.
float sums[DEPTHS];
float moments[DEPTHS];

// Marks which of the Gaussians from `begin` on are near the tile; then `near_blobs` holds for all lanes.
void mark_from(uint begin, Tile tile) {
    uint at = begin + gl_LocalInvocationID.x;
    mark_near(at < push.n_blobs && is_near(blobs[push.first_blob + min(at, push.n_blobs - 1u)], tile));
}

void main() {
    TileRay own = ray_of_lane();
    Tile tile = tile_of(own.ray);
    float first = setup.dynamic_near, step = (setup.dynamic_far - setup.dynamic_near) / float(DEPTHS - 1u);
    float sharpest = 4.0 / (step * step);
    float strongest = 0.0, strongest_at = first;
    for (uint k = 0u; k < DEPTHS; k++) {
        sums[k] = 0.0;
        moments[k] = 0.0;
    }
    for (uint begin = 0u; begin < push.n_blobs; begin += 64u) {
        mark_from(begin, tile);
        for (uint word = 0u; word < 2u; word++) {
            for (uint bits = near_blobs[word]; bits != 0u; bits &= bits - 1u) {
                Profile p = profile_of(blobs[push.first_blob + begin + 32u * word + uint(findLSB(bits))], own.ray);
                if (p.height == 0.0) continue;
                if (p.height > strongest) {
                    strongest = p.height;
                    strongest_at = p.at;
                }
                float steepness = min(p.steepness, sharpest);
                float half_width = REACH * inversesqrt(steepness);
                float low = clamp(ceil((p.at - half_width - first) / step), 0.0, float(DEPTHS));
                float high = clamp(floor((p.at + half_width - first) / step), -1.0, float(DEPTHS) - 1.0);
                for (int k = int(low); k <= int(high); k++) {
                    float d = first + float(k) * step - p.at;
                    float part = p.height * exp(-0.5 * steepness * d * d);
                    sums[k] += part;
                    moments[k] += part * p.at;
                }
            }
        }
    }
    uint best = 0u;
    for (uint k = 1u; k < DEPTHS; k++)
        if (sums[k] > sums[best]) best = k;
    vec2 depth = vec2(sums[best] > 0.0 ? moments[best] / sums[best] : first, strongest_at);
    float largest = 0.0;
    for (uint climb = 0u; climb < CLIMBS; climb++) {
        vec2 value = vec2(0.0), pull = vec2(0.0), weight = vec2(0.0);
        for (uint begin = 0u; begin < push.n_blobs; begin += 64u) {
            mark_from(begin, tile);
            for (uint word = 0u; word < 2u; word++) {
                for (uint bits = near_blobs[word]; bits != 0u; bits &= bits - 1u) {
                    Profile p = profile_of(blobs[push.first_blob + begin + 32u * word + uint(findLSB(bits))], own.ray);
                    vec2 d = depth - p.at;
                    vec2 part = p.height * exp(-0.5 * p.steepness * d * d);
                    value += part;
                    pull += part * p.steepness * p.at;
                    weight += part * p.steepness;
                }
            }
        }
        largest = max(largest, max(value.x, value.y));
        if (weight.x > 0.0) depth.x = pull.x / weight.x;
        if (weight.y > 0.0) depth.y = pull.y / weight.y;
    }
    if (!own.wanted) return;
    ray_out[own.index].dynamic_max = largest;
    ray_out[own.index].total_max = largest;
}
