// Shared by march_count and march_emit: one workgroup per ray, each lane owns a run of consecutive
// depths, so that live samples come out in depth order.
#include "inc/layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_ray; uint n_rays; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { uint state[]; };
layout(binding = 2) readonly buffer B2 { Ray rays[]; };
layout(binding = 3) readonly buffer B3 { uint hull[]; };
layout(binding = 8) readonly buffer B8 { uint occupancy[]; };
#include "inc/dynamic_box.glsl"
#include "inc/occupied.glsl"

bool sample_lives(vec3 x, uint phase) {
    return dynamic_inside(x, phase) && occupied(x, phase, state[0]);
}

uint run_length() {
    return (setup.n_dynamic_samples + gl_WorkGroupSize.x - 1u) / gl_WorkGroupSize.x;
}

uint depth_stream(Ray ray) {
    return setup.per_ray_depths != 0u ? ray.id + 1u : 0u;
}

float dynamic_depth(uint k, Ray ray) {
    return depth_at(k, setup.n_dynamic_samples, setup.dynamic_near, setup.dynamic_far, setup.jitter, setup.seed,
                    state[0], depth_stream(ray));
}
