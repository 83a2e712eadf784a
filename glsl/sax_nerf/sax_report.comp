#version 450
#extension GL_GOOGLE_include_directive : require
// Writes the iteration's loss, the mean over the fields, to a ring buffer and increments the count of iterations. One
// workgroup.
#include "inc/layout.glsl"
#include "inc/sax_layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/reduce.glsl"
layout(binding = 0) uniform B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { float sax_losses[]; };
layout(binding = 2) buffer B2 { DeviceState state; };
layout(binding = 3) writeonly buffer B3 { float sax_ring[]; };

void main() {
    float sum = 0.0;
    uint n = sax_setup.n_sets * sax_setup.n_rays;
    for (uint k = gl_LocalInvocationID.x; k < n; k += gl_WorkGroupSize.x) sum += sax_losses[k];
    float total = workgroup_sum(sum);
    if (gl_LocalInvocationID.x != 0u) return;
    sax_ring[state.step % sax_setup.ring_length] = total / float(sax_setup.n_sets);
    state.step += 1u;
}
