#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient of the static field: fixed-point sums (then cleared for the next iteration) with the total-variation term.
// One invocation per parameter.
#include "inc/layout.glsl"
#include "inc/fixed_point.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { float tv_gradient[]; };
layout(binding = 2) buffer B2 { uint static_gradient[]; };
layout(binding = 3) writeonly buffer B3 { float gradient[]; };

void main() {
    uint i = invocation();
    if (i >= setup.static_params) return;
    uvec2 sum = uvec2(static_gradient[2u * i], static_gradient[2u * i + 1u]);
    gradient[i] = from_fixed(sum, setup.fixed_point_bits) + tv_gradient[i];
    static_gradient[2u * i] = 0u;
    static_gradient[2u * i + 1u] = 0u;
}
