#version 450
#extension GL_GOOGLE_include_directive : require
// Collects the gradient: fixed-point sums of the static field (then cleared for the next iteration) with
// the total-variation term, and the splits of the network's weights. One invocation per parameter of
// [first, first + count).
#include "inc/layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first; uint count; uint splits; uint n_partials; uint partials_first; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { float tv_gradient[]; };
layout(binding = 2) readonly buffer B2 { float partials[]; };
layout(binding = 3) buffer B3 { uint static_gradient[]; };
layout(binding = 4) writeonly buffer B4 { float gradient[]; };

float from_fixed(uint parameter) {
    uint low = static_gradient[2u * parameter];
    uint high = static_gradient[2u * parameter + 1u];
    bool negative = (high & 0x80000000u) != 0u;
    if (negative) {
        low = ~low + 1u;
        high = ~high + (low == 0u ? 1u : 0u);
    }
    float magnitude = (float(high) * 4294967296.0 + float(low)) * exp2(-float(setup.fixed_point_bits));
    return negative ? -magnitude : magnitude;
}

void main() {
    uint i = push.first + gl_GlobalInvocationID.x;
    if (gl_GlobalInvocationID.x >= push.count) return;
    if (i < setup.static_params) {
        gradient[i] = from_fixed(i) + tv_gradient[i];
        static_gradient[2u * i] = 0u;
        static_gradient[2u * i + 1u] = 0u;
        return;
    }
    float sum = 0.0;
    for (uint split = 0u; split < push.splits; split++) {
        sum += partials[split * push.n_partials + i - push.partials_first];
    }
    gradient[i] = sum;
}
