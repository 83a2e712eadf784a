#version 450
#extension GL_GOOGLE_include_directive : require
// Adds up the partial sums of the network's gradient in a fixed order and divides the sums by the loss scale. The elements are
// [first, first + count) of `gradient`, followed by `phase_sums` sums of dz over the samples of a phase. `parts` invocations
// share the partial sums of an element. A sum that is not finite sets state.overflowed.
//   source[i]: position of element i in partials[split][n_partials]; NOWHERE: the element is zero.
#include "inc/layout.glsl"
#include "inc/positions.glsl"
layout(local_size_x = 128, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(constant_id = 1) const uint parts = 1u;  // a divisor of the workgroup's size
layout(push_constant) uniform Push { uint first; uint count; uint phase_sums; uint splits; uint n_partials; } push;
layout(binding = 0) readonly buffer B0 { uint source[]; };
layout(binding = 1) readonly buffer B1 { float partials[]; };
layout(binding = 2) writeonly buffer B2 { float gradient[]; };
layout(binding = 3) writeonly buffer B3 { float phase_dz[]; };
layout(binding = 4) buffer B4 { DeviceState state; };

shared float part_sums[gl_WorkGroupSize.x];

// Number of elements of a workgroup. Neighbouring invocations sum neighbouring elements.
const uint elements = gl_WorkGroupSize.x / parts;

void main() {
    uint element = gl_LocalInvocationIndex % elements;
    uint i = workgroup() * elements + element;
    bool is_element = i < push.count + push.phase_sums;
    uint at = is_element ? source[i] : NOWHERE;
    float sum = 0.0;
    if (at != NOWHERE) {
        for (uint split = gl_LocalInvocationIndex / elements; split < push.splits; split += parts) {
            sum += partials[split * push.n_partials + at];
        }
    }
    if (parts > 1u) {
        part_sums[gl_LocalInvocationIndex] = sum;
        barrier();
        if (gl_LocalInvocationIndex >= elements) return;
        for (uint part = 1u; part < parts; part++) sum += part_sums[part * elements + element];
    }
    if (!is_element) return;
    // The test reads all bits of the exponent, because a compiler may assume that isinf and isnan are always false.
    if ((floatBitsToUint(sum) & 0x7f800000u) == 0x7f800000u) atomicOr(state.overflowed, 1u);
    if (i < push.count) {
        gradient[push.first + i] = sum / state.loss_scale;
    } else {
        phase_dz[i - push.count] = sum / state.loss_scale;
    }
}
