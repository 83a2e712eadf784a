#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// The largest attenuation along each ray where far more Gaussians overlap than gaussian_rays keeps peaks of, and where
// there is no still field: their sum at regular depths, then uphill from the largest, from where narrow ones
// between these add up to most, and from the strongest Gaussian, over all of them each time. One workgroup per tile of 8 x 8 pixels, one invocation per ray.
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
const uint CLIMBS = 12u;
// Standard deviations along the ray beyond which a Gaussian adds nothing that counts.
const float REACH = 4.0;

// What Gaussians add at a depth.
float plain[DEPTHS];
// The same where none counts as narrower than half a step, so that those between two depths are found, and that times where
// they peak.
float sums[DEPTHS];
float moments[DEPTHS];

// Marks which of the Gaussians from `begin` on are near the tile; then `near_blobs` holds for all lanes.
void mark_from(uint begin, Tile tile) {
    uint at = begin + gl_LocalInvocationID.x;
    mark_near(at < push.n_blobs && is_near(blobs[push.first_blob + min(at, push.n_blobs - 1u)], tile));
}

// Where the highest of the peaks that are lower than `below` is; DEPTHS if there is none.
uint highest_peak(float below) {
    uint best = DEPTHS;
    float highest = 0.0;
    for (uint k = 0u; k < DEPTHS; k++) {
        float beside = max(k > 0u ? sums[k - 1u] : 0.0, k + 1u < DEPTHS ? sums[k + 1u] : 0.0);
        if (sums[k] >= beside && sums[k] < below && sums[k] > highest) {
            best = k;
            highest = sums[k];
        }
    }
    return best;
}

void main() {
    TileRay own = ray_of_lane();
    Tile tile = tile_of(own.ray);
    float first = setup.dynamic_near, step = (setup.dynamic_far - setup.dynamic_near) / float(DEPTHS - 1u);
    float sharpest = 4.0 / (step * step);
    float strongest = 0.0, strongest_at = first;
    for (uint k = 0u; k < DEPTHS; k++) {
        plain[k] = 0.0;
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
                    plain[k] += p.height * exp(-0.5 * p.steepness * d * d);
                    sums[k] += part;
                    moments[k] += part * p.at;
                }
            }
        }
    }
    uint best = 0u;
    for (uint k = 1u; k < DEPTHS; k++)
        if (plain[k] > plain[best]) best = k;
    vec4 depth = vec4(first + float(best) * step, vec3(strongest_at));
    float below = 1e30;
    [[unroll]] for (uint start = 1u; start < 3u; start++) {
        uint peak = highest_peak(below);
        if (peak == DEPTHS) break;
        below = sums[peak];
        depth[start] = moments[peak] / below;
    }
    float largest = 0.0;
    for (uint climb = 0u; climb < CLIMBS; climb++) {
        vec4 value = vec4(0.0), pull = vec4(0.0), weight = vec4(0.0);
        for (uint begin = 0u; begin < push.n_blobs; begin += 64u) {
            mark_from(begin, tile);
            for (uint word = 0u; word < 2u; word++) {
                for (uint bits = near_blobs[word]; bits != 0u; bits &= bits - 1u) {
                    Profile p = profile_of(blobs[push.first_blob + begin + 32u * word + uint(findLSB(bits))], own.ray);
                    vec4 d = depth - p.at;
                    vec4 part = p.height * exp(-0.5 * p.steepness * d * d);
                    value += part;
                    pull += part * p.steepness * p.at;
                    weight += part * p.steepness;
                }
            }
        }
        largest = max(largest, max(max(value.x, value.y), max(value.z, value.w)));
        // Far from all there is nothing to climb.
        depth = mix(depth, pull / max(weight, vec4(1e-30)), greaterThan(weight, vec4(0.0)));
    }
    if (!own.wanted) return;
    ray_out[own.index].dynamic_max = largest;
    ray_out[own.index].total_max = largest;
}
