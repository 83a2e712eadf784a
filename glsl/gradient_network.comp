#version 450
#extension GL_GOOGLE_include_directive : require
// Adds up the partial sums of the network's gradient in a fixed order and takes the loss scale out. One invocation per
// element of [first, first + count) of `gradient`; a sum that is not finite is flagged in state.overflowed.
//   source[i]: where element first + i lies in partials[split][n_partials]; NOWHERE: zero.
#include "inc/layout.glsl"
#include "inc/positions.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first; uint count; uint splits; uint n_partials; } push;
layout(binding = 0) readonly buffer B0 { uint source[]; };
layout(binding = 1) readonly buffer B1 { float partials[]; };
layout(binding = 2) writeonly buffer B2 { float gradient[]; };
layout(binding = 3) buffer B3 { DeviceState state; };

void main() {
    uint i = gl_GlobalInvocationID.x;
    if (i >= push.count) return;
    uint at = source[i];
    float sum = 0.0;
    if (at != NOWHERE) {
        for (uint split = 0u; split < push.splits; split++) sum += partials[split * push.n_partials + at];
    }
    // All bits of the exponent: a compiler may assume that isinf and isnan are false.
    if ((floatBitsToUint(sum) & 0x7f800000u) == 0x7f800000u) state.overflowed = 1u;
    gradient[push.first + i] = sum / state.loss_scale;
}
