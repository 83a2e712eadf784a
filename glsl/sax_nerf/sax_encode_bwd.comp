#version 450
#extension GL_GOOGLE_include_directive : require
// Scatters the gradient with respect to the samples' features to the grid's entries, in 64-bit fixed point. One invocation per
// sample and pair of levels.
//   sax_grid_sums[2 * number] = low and high word
#include "inc/fixed_point.glsl"
#include "inc/sax_layout.glsl"
#include "inc/sax_hash.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_samples; } push;
layout(binding = 0) uniform B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { SaxLevel sax_levels[]; };
layout(binding = 2) readonly buffer B2 { vec4 sax_points[]; };
layout(binding = 3) readonly buffer B3 { vec4 sax_encoding_gradient[]; };
FIXED_SUMS(4, B4, sax_grid_sums);

void scatter(SaxLevel level, vec3 unit, vec2 gradient) {
    float scale_high = exp2(float(sax_setup.fixed_point_bits) - 32.0);
    SaxCell cell = cell_at(level, unit);
    for (uint corner = 0u; corner < 8u; corner++) {
        float share;
        uint entry = tap(level, cell, corner, share);
        vec2 part = share * gradient;
        if (part.x != 0.0) ADD_FIXED_TO_MEMORY(sax_grid_sums, 2u * entry, to_fixed(part.x, scale_high));
        if (part.y != 0.0) ADD_FIXED_TO_MEMORY(sax_grid_sums, 2u * entry + 1u, to_fixed(part.y, scale_high));
    }
}

void main() {
    uint i = invocation();
    if (i >= push.n_samples * (sax_setup.n_levels / 2u)) return;
    uint pair = i / push.n_samples;
    vec3 unit = sax_points[i % push.n_samples].xyz;
    vec4 gradient = sax_encoding_gradient[i];
    scatter(sax_levels[2u * pair], unit, gradient.xy);
    scatter(sax_levels[2u * pair + 1u], unit, gradient.zw);
}
