#version 450
#extension GL_GOOGLE_include_directive : require
// Converts the sample counts of a chunk's rays to offsets (exclusive prefix sum over rays, one workgroup) and writes the
// indirect arguments of all passes over live samples. No sample is live while the dynamic field is delayed or after training
// has stopped.
//   ray_counts of the chunk's rays -> ray_start[n_rays + 1];  live: numbers of live samples.
#include "inc/layout.glsl"
layout(local_size_x = 256, local_size_x_id = 0) in;
layout(push_constant) uniform Push {
    uint first_ray; uint n_rays; uint tile_samples; uint forward_rows; uint backward_rows; uint accumulate;
} push;
layout(binding = 0) readonly buffer B0 { DeviceState state; };
layout(binding = 1) readonly buffer B1 { Schedule schedule[]; };
layout(binding = 2) readonly buffer B2 { uint ray_counts[]; };
layout(binding = 3) writeonly buffer B3 { uint ray_start[]; };
layout(binding = 4) buffer B4 { LiveSamples live; };
layout(binding = 5) writeonly buffer B5 { IndirectArguments arguments; };

#include "inc/combine.glsl"

PREFIX(samples_before, totals, gl_WorkGroupSize.x)

void main() {
    uint lane = workgroup_lane();
    uint active_now = state.stopped != 0u ? 0u : schedule[state.step].dynamic_active;
    uint per = (push.n_rays + gl_WorkGroupSize.x - 1u) / gl_WorkGroupSize.x;
    uint begin = min(lane * per, push.n_rays);
    uint end = min(begin + per, push.n_rays);
    uint sum = 0u;
    for (uint r = begin; r < end; r++) sum += ray_counts[push.first_ray + r];
    uint running = samples_before(sum * active_now);
    if (lane == gl_WorkGroupSize.x - 1u) {
        uint count = running + sum * active_now;
        uint padded = (count + SAMPLE_GROUP - 1u) / SAMPLE_GROUP * SAMPLE_GROUP;
        live.count = count;
        live.padded = padded;
        live.of_iteration = count + (push.accumulate != 0u ? live.of_iteration : 0u);
        ray_start[push.n_rays] = count;
        uint tiles = (padded + push.tile_samples - 1u) / push.tile_samples;
        arguments.samples = DispatchSize(padded / SAMPLE_GROUP, 1u, 1u);
        arguments.forward_tiles = DispatchSize(tiles, push.forward_rows, 1u);
        arguments.backward_tiles = DispatchSize(tiles, push.backward_rows, 1u);
    }
    for (uint r = begin; r < end; r++) {
        ray_start[r] = running;
        running += ray_counts[push.first_ray + r] * active_now;
    }
}
