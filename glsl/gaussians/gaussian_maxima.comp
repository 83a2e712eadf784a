#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Maximum attenuation along each ray, for models in which far more Gaussians overlap than gaussian_rays keeps peaks of, and
// without a static field. The sum of the Gaussians is evaluated at regular depths. A fixed-point iteration then climbs from the
// maximum of these samples and from the peaks of the three strongest Gaussians, which may lie between the depths. Each step of
// it sums over all Gaussians. One workgroup per tile of 8 x 8 pixels, one invocation per ray.
//   ray_out[ray].dynamic_max, total_max
// Reference implementation: reference::blobs.
#include "inc/layout.glsl"
#include "inc/gaussian_layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/reduce.glsl"
layout(push_constant) uniform Push { uint n_rays; uint image_width; uint first_blob; uint n_blobs; } push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { Ray rays[]; };
layout(binding = 2) readonly buffer B2 { Blob blobs[]; };
layout(binding = 3) buffer B3 { RayOut ray_out[]; };
#include "inc/blobs.glsl"
#include "inc/blob_rays.glsl"

// Number of depths at which the sum is evaluated.
const uint DEPTHS = 128u;
// Number of steps of the iteration towards the peak.
const uint CLIMBS = 12u;
// Distance along the ray, in standard deviations, beyond which a Gaussian's contribution is negligible.
const float REACH = 4.0;

float sums[DEPTHS];

// Marks the Gaussians from `begin` on that are near the tile; afterwards `near_blobs` is valid in all lanes.
void mark_from(uint begin, Tile tile) {
    uint at = begin + gl_LocalInvocationID.x;
    mark_near(at < push.n_blobs && is_near(blobs[push.first_blob + min(at, push.n_blobs - 1u)], tile));
}

// Keeps the three strongest Gaussians of a ray in descending order: their `heights` and the depths of their peaks (`places`).
void keep_strongest(float height, float at, inout vec3 heights, inout vec3 places) {
    if (height <= heights.z) return;
    if (height > heights.x) {
        heights = vec3(height, heights.xy);
        places = vec3(at, places.xy);
    } else if (height > heights.y) {
        heights = vec3(heights.x, height, heights.y);
        places = vec3(places.x, at, places.y);
    } else {
        heights.z = height;
        places.z = at;
    }
}

void main() {
    TileRay own = ray_of_lane();
    Tile tile = tile_of(own.ray);
    float first = setup.dynamic_near, step = (setup.dynamic_far - setup.dynamic_near) / float(DEPTHS - 1u);
    vec3 heights = vec3(0.0), places = vec3(first);
    for (uint k = 0u; k < DEPTHS; k++) sums[k] = 0.0;
    for (uint begin = 0u; begin < push.n_blobs; begin += 64u) {
        mark_from(begin, tile);
        for (uint word = 0u; word < 2u; word++) {
            for (uint bits = near_blobs[word]; bits != 0u; bits &= bits - 1u) {
                Profile p = profile_of(blobs[push.first_blob + begin + 32u * word + uint(findLSB(bits))], own.ray);
                if (p.height == 0.0) continue;
                keep_strongest(p.height, p.at, heights, places);
                float half_width = REACH * inversesqrt(p.steepness);
                float low = clamp(ceil((p.at - half_width - first) / step), 0.0, float(DEPTHS));
                float high = clamp(floor((p.at + half_width - first) / step), -1.0, float(DEPTHS) - 1.0);
                for (int k = int(low); k <= int(high); k++) {
                    float d = first + float(k) * step - p.at;
                    sums[k] += p.height * exp(-0.5 * p.steepness * d * d);
                }
            }
        }
    }
    uint best = 0u;
    for (uint k = 1u; k < DEPTHS; k++)
        if (sums[k] > sums[best]) best = k;
    vec4 depth = vec4(first + float(best) * step, places);
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
        // Where no Gaussian contributes, the depth does not change.
        depth = mix(depth, pull / max(weight, vec4(1e-30)), greaterThan(weight, vec4(0.0)));
    }
    if (!own.wanted) return;
    ray_out[own.index].dynamic_max = largest;
    ray_out[own.index].total_max = largest;
}
