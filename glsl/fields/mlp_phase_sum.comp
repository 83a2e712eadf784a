#version 450
#extension GL_GOOGLE_include_directive : require
// Sums ray_dz over the rays of each phase: phase_dz[layer][phase][4 neurons]. A ray between two phases contributes its shares
// to both. One workgroup per (4 neurons, phase). The order of the sums is fixed, and later chunks of an iteration add to them.
#include "inc/layout.glsl"
#include "inc/phase_share.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_ray; uint n_rays; uint row; uint groups; uint accumulate; } push;
layout(binding = 0) readonly buffer B0 { Ray rays[]; };
layout(binding = 1) readonly buffer B1 { vec4 ray_dz[]; };
layout(binding = 2) buffer B2 { vec4 phase_dz[]; };

#include "inc/reduce.glsl"

void main() {
    uint q = gl_WorkGroupID.x;
    uint phase = gl_WorkGroupID.y;
    vec4 sum = vec4(0.0);
    for (uint r = gl_LocalInvocationID.x; r < push.n_rays; r += gl_WorkGroupSize.x) {
        float share = phase_share(rays[push.first_ray + r], phase);
        if (share > 0.0) sum += share * ray_dz[q * push.n_rays + r];
    }
    vec4 total = workgroup_sum(sum);
    if (gl_LocalInvocationID.x != 0u) return;
    uint at = (push.row + phase) * push.groups + q;
    phase_dz[at] = total + (push.accumulate != 0u ? phase_dz[at] : vec4(0.0));
}
