#version 450
#extension GL_GOOGLE_include_directive : require
// Writes the iteration's loss to a ring buffer and increments the count of iterations. Neither happens if the tiles' lists
// exceeded the capacity; the host reads this from `x_status`. One workgroup.
#include "inc/blend_layout.glsl"
#include "inc/gaussian_layout.glsl"
#include "inc/x_layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/reduce.glsl"
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { BlendSetup blend_setup; };
layout(binding = 2) readonly buffer B2 { BlendCounts blend_counts; };
layout(binding = 3) readonly buffer B3 { float gaussian_loss_parts[]; };
layout(binding = 4) buffer B4 { uint gaussian_step; };
layout(binding = 5) writeonly buffer B5 { float gaussian_ring[]; };
layout(binding = 6) writeonly buffer B6 { XStatus x_status; };

void main() {
    float sum = 0.0;
    for (uint k = gl_LocalInvocationID.x; k < gaussian_setup.n_loss_parts; k += gl_WorkGroupSize.x)
        sum += gaussian_loss_parts[k];
    float total = workgroup_sum(sum);
    if (gl_LocalInvocationID.x != 0u) return;
    uint step = gaussian_step;
    if (blend_counts.entries <= blend_setup.capacity) {
        gaussian_ring[step % gaussian_setup.ring_length] = total;
        step += 1u;
    }
    gaussian_step = step;
    x_status.entries = blend_counts.entries;
    x_status.step = step;
}
