// Common parts of march_count and march_emit. Each lane of a ray has a range of consecutive depths, so that live samples are in
// the order of depths. lane_masks[ray][lane][word]: one bit per depth of the range.
#include "inc/layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_ray; uint n_rays; } push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { Ray rays[]; };
#include "inc/march_rays.glsl"

uint run_length() {
    return (setup.n_dynamic_samples + ray_lanes - 1u) / ray_lanes;
}

// Number of words of a lane's mask.
uint mask_words() {
    return (run_length() + 31u) / 32u;
}

uint depth_stream(Ray ray) {
    return setup.per_ray_depths != 0u ? ray.id + 1u : 0u;
}

float dynamic_depth(uint k, Ray ray) {
    return depth_at(k, setup.n_dynamic_samples, setup.dynamic_near, setup.dynamic_far, setup.jitter, setup.seed,
                    state.step, depth_stream(ray));
}
