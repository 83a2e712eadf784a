#version 450
#extension GL_GOOGLE_include_directive : require
// Turns the counts of a chunk into offsets (exclusive prefix sum over rays, one workgroup) and writes the
// indirect arguments of all passes over live samples. While the dynamic field is delayed nothing is live.
//   ray_counts[n_rays] -> ray_start[n_rays + 1];  live = live, padded to 64, live of the iteration so far.
#include "inc/layout.glsl"
layout(local_size_x = 256, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_rays; uint tile_samples; uint fwd_y; uint bwd_y; uint accumulate; } push;
layout(binding = 0) readonly buffer B0 { uint state[]; };
layout(binding = 1) readonly buffer B1 { Schedule schedule[]; };
layout(binding = 2) readonly buffer B2 { uint ray_counts[]; };
layout(binding = 3) writeonly buffer B3 { uint ray_start[]; };
layout(binding = 4) buffer B4 { uint live[]; };
layout(binding = 5) writeonly buffer B5 { uint arguments[]; };

shared uint totals[gl_WorkGroupSize.x];

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint active_now = schedule[state[0]].dynamic_active;
    uint per = (push.n_rays + gl_WorkGroupSize.x - 1u) / gl_WorkGroupSize.x;
    uint begin = min(lane * per, push.n_rays);
    uint end = min(begin + per, push.n_rays);
    uint sum = 0u;
    for (uint r = begin; r < end; r++) sum += ray_counts[r];
    totals[lane] = sum * active_now;
    barrier();
    if (lane == 0u) {
        uint running = 0u;
        for (uint i = 0u; i < gl_WorkGroupSize.x; i++) {
            uint here = totals[i];
            totals[i] = running;
            running += here;
        }
        uint padded = (running + 63u) / 64u * 64u;
        live[0] = running;
        live[1] = padded;
        live[2] = running + (push.accumulate != 0u ? live[2] : 0u);
        ray_start[push.n_rays] = running;
        // 0: one invocation per padded sample, groups of 64
        arguments[0] = padded / 64u;
        arguments[1] = 1u;
        arguments[2] = 1u;
        // 1, 2: layer tiles, forward and backward to the input
        uint tiles = (padded + push.tile_samples - 1u) / push.tile_samples;
        arguments[4] = tiles;
        arguments[5] = push.fwd_y;
        arguments[6] = 1u;
        arguments[8] = tiles;
        arguments[9] = push.bwd_y;
        arguments[10] = 1u;
    }
    barrier();
    uint running = totals[lane];
    for (uint r = begin; r < end; r++) {
        ray_start[r] = running;
        running += ray_counts[r] * active_now;
    }
}
