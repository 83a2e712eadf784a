#version 450
#extension GL_GOOGLE_include_directive : require
// Writes the iteration's loss to a ring buffer and increments the count of iterations. One workgroup.
#include "inc/gaussian.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/reduce.glsl"
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) readonly buffer B1 { float gaussian_loss_parts[]; };
layout(binding = 2) buffer B2 { uint gaussian_step; };
layout(binding = 3) writeonly buffer B3 { float gaussian_ring[]; };

void main() {
    float sum = 0.0;
    for (uint k = gl_LocalInvocationID.x; k < gaussian_setup.n_loss_parts; k += gl_WorkGroupSize.x)
        sum += gaussian_loss_parts[k];
    float total = workgroup_sum(sum);
    if (gl_LocalInvocationID.x != 0u) return;
    gaussian_ring[gaussian_step % gaussian_setup.ring_length] = total;
    gaussian_step += 1u;
}
