#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient of the static field: the sum of the fixed-point gradient of the rays (which is then cleared for the next iteration)
// and the gradient of the total variation of planes and lines (paper, L_TV). One invocation per parameter.
//   planes: tv_plane * 2 * (mean squared difference along v + along u); lines: tv_line * 2 * mean squared difference.
//   The value of each pair of neighbours is counted at its lower element.
//   tv_parts[workgroup]: the workgroup's part of the total variation.
#include "inc/layout.glsl"
#include "inc/fixed_point.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint ranks; } push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { float params[]; };
layout(binding = 2) buffer B2 { uint static_gradient[]; };
layout(binding = 3) writeonly buffer B3 { float gradient[]; };
layout(binding = 4) writeonly buffer B4 { float tv_parts[]; };
#include "inc/reduce.glsl"

// Contribution of a parameter to the total variation, and the derivative of the total variation with respect to it.
struct Variation {
    float value;
    float slope;
};

// Adds the terms of the pairs that contain element i, at position `at` along an axis with `stride`.
void add_pairs(inout Variation sum, uint i, uint at, uint stride, float weight) {
    if (at + 1u < setup.grid) {
        float difference = params[i + stride] - params[i];
        sum.value += weight * difference * difference;
        sum.slope -= 2.0 * weight * difference;
    }
    if (at > 0u) sum.slope += 2.0 * weight * (params[i] - params[i - stride]);
}

Variation variation(uint i) {
    uint d = setup.grid;
    uint components = 4u * setup.rank4;
    Variation sum = Variation(0.0, 0.0);
    uint texel = i / components;
    if (texel < 3u * d * d) {
        float weight = setup.tv_plane * 2.0 / float(push.ranks * d * (d - 1u));
        uint cell = texel % (d * d);
        add_pairs(sum, i, cell / d, d * components, weight);
        add_pairs(sum, i, cell % d, components, weight);
    } else {
        float weight = setup.tv_line * 2.0 / float(push.ranks * (d - 1u));
        add_pairs(sum, i, (texel - 3u * d * d) % d, components, weight);
    }
    return sum;
}

void main() {
    uint i = invocation();
    float value = 0.0;
    if (i < setup.static_params) {
        Variation tv = variation(i);
        value = tv.value;
        uvec2 sum = uvec2(static_gradient[2u * i], static_gradient[2u * i + 1u]);
        gradient[i] = from_fixed(sum, setup.fixed_point_bits) + tv.slope;
        static_gradient[2u * i] = 0u;
        static_gradient[2u * i + 1u] = 0u;
    }
    float total = workgroup_sum(value);
    if (gl_LocalInvocationID.x == 0u && i < setup.static_params) tv_parts[workgroup()] = total;
}
