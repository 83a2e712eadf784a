#version 450
#extension GL_GOOGLE_include_directive : require
// Clears a slice of the next epoch's occupancy: all of it within one epoch. One invocation per word of a slice.
#include "inc/layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { DeviceState state; };
layout(binding = 2) writeonly buffer B2 { uint occupancy[]; };
#include "inc/occupancy.glsl"

void main() {
    uint slice = (occupancy_words() + OCCUPANCY_EPOCH - 1u) / OCCUPANCY_EPOCH;
    uint word = state.step % OCCUPANCY_EPOCH * slice + gl_GlobalInvocationID.x;
    if (gl_GlobalInvocationID.x >= slice || word >= occupancy_words()) return;
    uint next = (state.step / OCCUPANCY_EPOCH + 1u) % OCCUPANCY_EPOCHS;
    occupancy[next * occupancy_words() + word] = 0u;
}
