#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// The largest attenuation along each ray where far more Gaussians overlap than gaussian_rays keeps peaks of, and where
// there is no still field: their sum at regular depths, stretch by stretch, then uphill from the largest and from the three strongest
// Gaussians, which may lie between these depths, over all of them each time. One workgroup per tile of 8 x 8 pixels, one invocation per ray.
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

// Stretches of the rays at most, and depths of each at which the sum is taken.
const uint STRETCHES = 4u;
const uint DEPTHS = 32u;
// Deviations of the narrowest Gaussian from one depth to the next, where there are enough depths.
const float STEP = 1.0;
// Most steps towards the peak.
const uint CLIMBS = 12u;
// A step that is less of a deviation of what pulls there than this ends the climb: the peak is higher by half its square.
const float LEAST_STEP = 0.03;
// So many times its reach away along the ray a Gaussian adds nothing that counts.
const float FAR = 1.5;
const float ENDLESS = 1e30;
const float ENDLESS_DEPTHS = 1e6;

// Whether a Gaussian may matter to the tile's rays between two depths.
bool is_between(Blob b, Tile tile, vec2 depths) {
    vec3 w = b.centre - tile.first.anchor, along = tile.first.direction;
    float depth = dot(w, along) / dot(along, along);
    float away = FAR * b.reach + 1.1 * (tile.spread + (length(w) + abs(depth)) * tile.spread_per_depth);
    float margin = away * inversesqrt(dot(along, along));
    return depth + margin >= depths.x && depth - margin <= depths.y;
}

// Stretches that the tile's narrowest Gaussian takes.
uint stretches_of(Tile tile) {
    float stretch = 0.0;
    for (uint at = gl_LocalInvocationID.x; at < push.n_blobs; at += 64u) {
        Blob b = blobs[push.first_blob + at];
        if (is_near(b, tile)) stretch = max(stretch, stretch_of(b));
    }
    float depths = (setup.dynamic_far - setup.dynamic_near) * workgroup_max(stretch) / STEP;
    return clamp(uint(ceil(min(depths, ENDLESS_DEPTHS) / float(DEPTHS))), 1u, STRETCHES);
}

// Marks which of the Gaussians from `begin` on may matter to the tile between two depths; then `near_blobs` holds for all
// lanes.
void mark_from(uint begin, Tile tile, vec2 depths) {
    uint at = begin + gl_LocalInvocationID.x;
    Blob b = blobs[push.first_blob + min(at, push.n_blobs - 1u)];
    mark_near(at < push.n_blobs && is_near(b, tile) && is_between(b, tile, depths));
}

// Keeps the three strongest Gaussians of a ray, strongest first: `heights` and where they peak.
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

// The largest sum of a stretch, and where it is; Gaussians that peak within `peaks` compete for the strongest.
vec2 best_of_stretch(Tile tile, Ray ray, float first, float step, vec2 peaks, inout vec3 heights, inout vec3 places) {
    vec4 sums[DEPTHS / 4u];
    [[unroll]] for (uint k = 0u; k < DEPTHS / 4u; k++) sums[k] = vec4(0.0);
    vec4 four = first + vec4(0.0, 1.0, 2.0, 3.0) * step;
    for (uint begin = 0u; begin < push.n_blobs; begin += 64u) {
        mark_from(begin, tile, peaks);
        for (uint word = 0u; word < 2u; word++) {
            for (uint bits = near_blobs[word]; bits != 0u; bits &= bits - 1u) {
                Profile p = profile_of(blobs[push.first_blob + begin + 32u * word + uint(findLSB(bits))], ray);
                if (p.at >= peaks.x && p.at < peaks.y) keep_strongest(p.height, p.at, heights, places);
                [[unroll]] for (uint k = 0u; k < DEPTHS / 4u; k++) {
                    vec4 d = four + (4.0 * float(k) * step - p.at);
                    sums[k] += p.height * exp(-0.5 * p.steepness * d * d);
                }
            }
        }
    }
    vec2 best = vec2(-1.0, first);
    [[unroll]] for (uint k = 0u; k < DEPTHS; k++)
        if (sums[k / 4u][k % 4u] > best.x) best = vec2(sums[k / 4u][k % 4u], first + float(k) * step);
    return best;
}

// Sums at four depths, which are left where each sum pulls them; the longest way there, in deviations.
vec4 climb(Tile tile, Ray ray, inout vec4 depth, out float moved) {
    vec4 value = vec4(0.0), pull = vec4(0.0), weight = vec4(0.0);
    vec2 range = vec2(min(min(depth.x, depth.y), min(depth.z, depth.w)), max(max(depth.x, depth.y), max(depth.z, depth.w)));
    range = vec2(-workgroup_max(-range.x), workgroup_max(range.y));
    for (uint begin = 0u; begin < push.n_blobs; begin += 64u) {
        mark_from(begin, tile, range);
        for (uint word = 0u; word < 2u; word++) {
            for (uint bits = near_blobs[word]; bits != 0u; bits &= bits - 1u) {
                Profile p = profile_of(blobs[push.first_blob + begin + 32u * word + uint(findLSB(bits))], ray);
                vec4 d = p.at - depth;
                vec4 part = p.height * exp(-0.5 * p.steepness * d * d);
                value += part;
                pull += part * p.steepness * d;
                weight += part * p.steepness;
            }
        }
    }
    // Far from all there is nothing to climb.
    vec4 way = mix(vec4(0.0), pull / max(weight, vec4(1e-30)), greaterThan(weight, vec4(0.0)));
    depth += way;
    vec4 steps = abs(way) * sqrt(weight / max(value, vec4(1e-30)));
    moved = workgroup_max(max(max(steps.x, steps.y), max(steps.z, steps.w)));
    return value;
}

void main() {
    TileRay own = ray_of_lane();
    Tile tile = tile_of(own.ray);
    uint n = stretches_of(tile);
    float near = setup.dynamic_near, step = (setup.dynamic_far - near) / float(n * DEPTHS - 1u);
    vec3 heights = vec3(0.0), places = vec3(near);
    vec2 best = vec2(-1.0, near);
    for (uint stretch = 0u; stretch < n; stretch++) {
        float first = near + float(stretch * DEPTHS) * step;
        // Peaks beyond both ends count with the nearest stretch.
        vec2 peaks = vec2(stretch == 0u ? -ENDLESS : first, stretch == n - 1u ? ENDLESS : first + float(DEPTHS) * step);
        vec2 found = best_of_stretch(tile, own.ray, first, step, peaks, heights, places);
        if (found.x > best.x) best = found;
    }
    vec4 depth = vec4(best.y, places);
    float largest = 0.0, moved = ENDLESS;
    for (uint k = 0u; k < CLIMBS && moved > LEAST_STEP; k++) {
        vec4 value = climb(tile, own.ray, depth, moved);
        largest = max(largest, max(max(value.x, value.y), max(value.z, value.w)));
    }
    if (!own.wanted) return;
    ray_out[own.index].dynamic_max = largest;
    ray_out[own.index].total_max = largest;
}
