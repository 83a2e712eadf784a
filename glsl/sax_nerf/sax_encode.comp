#version 450
#extension GL_GOOGLE_include_directive : require
// Features of the hash grid at samples: two numbers per level, interpolated between eight entries. One invocation per sample
// and pair of levels.
//   sax_encoding[pair of levels][sample]
#include "inc/sax_layout.glsl"
#include "inc/sax_hash.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_samples; } push;
layout(binding = 0) uniform B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { SaxLevel sax_levels[]; };
layout(binding = 2) readonly buffer B2 { vec4 sax_points[]; };
layout(binding = 3) readonly buffer B3 { vec2 sax_params[]; };   // numbers of the Lineformer, followed by the grid's entries
layout(binding = 4) writeonly buffer B4 { vec4 sax_encoding[]; };

vec2 features(SaxLevel level, vec3 unit) {
    SaxCell cell = cell_at(level, unit);
    vec2 sum = vec2(0.0);
    for (uint corner = 0u; corner < 8u; corner++) {
        float share;
        uint entry = tap(level, cell, corner, share);
        sum += share * sax_params[sax_setup.n_weights / 2u + entry];
    }
    return sum;
}

void main() {
    uint i = invocation();
    if (i >= push.n_samples * (sax_setup.n_levels / 2u)) return;
    uint pair = i / push.n_samples;
    vec3 unit = sax_points[i % push.n_samples].xyz;
    sax_encoding[i] = vec4(features(sax_levels[2u * pair], unit), features(sax_levels[2u * pair + 1u], unit));
}
