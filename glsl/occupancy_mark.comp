#version 450
#extension GL_GOOGLE_include_directive : require
// Notes for the cell of each live sample, at the phases that it shows, that it was seen, and whether it was occupied: of a phase
// that it shows little of, only that it was occupied. One invocation per sample.
#include "inc/layout.glsl"
#include "inc/sample_rays.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) readonly buffer B2 { LiveSamples live; };
layout(binding = 3) readonly buffer B3 { vec4 sample_points[]; };
layout(binding = 4) readonly buffer B4 { uint sample_rays[]; };
layout(binding = 5) readonly buffer B5 { Ray rays[]; };
layout(binding = 6) readonly buffer B6 { vec2 sample_sigma[]; };
layout(binding = 7) buffer B7 { uint occupancy[]; };
#include "inc/occupancy.glsl"

void mark(uint entry, uint bits) {
    uint epoch = state.step / OCCUPANCY_EPOCH;
    uint word = (epoch % OCCUPANCY_EPOCHS) * occupancy_words() + entry / CELLS_PER_WORD;
    atomicOr(occupancy[word], bits << (2u * (entry % CELLS_PER_WORD)));
}

void main() {
    uint s = gl_GlobalInvocationID.x;
    if (s >= live.count) return;
    vec3 x = sample_points[s].xyz;
    Ray ray = rays[ray_of(sample_rays[s])];
    bool full = sample_sigma[s].x > setup.occupancy_threshold;
    uint bits = SEEN | (full ? OCCUPIED : 0u);
    mark(occupancy_entry(x, ray.phase), bits);
    if (ray.beyond_share >= LITTLE_SHOWN || full && ray.beyond_share > 0.0) mark(occupancy_entry(x, ray.beyond), bits);
}
