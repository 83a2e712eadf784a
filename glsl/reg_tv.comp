#version 450
#extension GL_GOOGLE_include_directive : require
// Total variation of planes and lines (paper, L_TV): value and gradient.
//   planes: tv_plane * 2 * (mean squared difference along v + along u); lines: tv_line * 2 * mean squared difference.
//   Each neighbour pair belongs to its lower element. One invocation per static parameter.
#include "inc/layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint ranks; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { float params[]; };
layout(binding = 2) writeonly buffer B2 { float tv_gradient[]; };
layout(binding = 3) writeonly buffer B3 { float tv_value[]; };

// Adds the pair terms of element i at position `at` along an axis with `stride`.
void axis(uint i, uint at, uint stride, float weight, inout float value, inout float slope) {
    if (at + 1u < setup.grid) {
        float difference = params[i + stride] - params[i];
        value += weight * difference * difference;
        slope -= 2.0 * weight * difference;
    }
    if (at > 0u) slope += 2.0 * weight * (params[i] - params[i - stride]);
}

void main() {
    uint i = invocation();
    if (i >= setup.static_params) return;
    uint d = setup.grid;
    uint components = 4u * setup.rank4;
    float value = 0.0;
    float slope = 0.0;
    uint texel = i / components;
    if (texel < 3u * d * d) {
        float weight = setup.tv_plane * 2.0 / float(push.ranks * d * (d - 1u));
        uint cell = texel % (d * d);
        axis(i, cell / d, d * components, weight, value, slope);
        axis(i, cell % d, components, weight, value, slope);
    } else {
        float weight = setup.tv_line * 2.0 / float(push.ranks * (d - 1u));
        axis(i, (texel - 3u * d * d) % d, components, weight, value, slope);
    }
    tv_gradient[i] = slope;
    tv_value[i] = value;
}
