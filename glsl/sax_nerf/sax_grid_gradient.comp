#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient of the grid's numbers from the fixed-point sums, which are then cleared for the next field. One invocation per
// number.
#include "inc/sax_layout.glsl"
#include "inc/fixed_point.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(binding = 0) uniform B0 { SaxSetup sax_setup; };
layout(binding = 1) buffer B1 { uint sax_grid_sums[]; };
layout(binding = 2) writeonly buffer B2 { float gradient[]; };  // numbers of the Lineformer, followed by those of the grid

void main() {
    uint i = invocation();
    if (i >= sax_setup.n_grid) return;
    uvec2 sum = uvec2(sax_grid_sums[2u * i], sax_grid_sums[2u * i + 1u]);
    gradient[sax_setup.n_weights + i] = from_fixed(sum, sax_setup.fixed_point_bits);
    sax_grid_sums[2u * i] = 0u;
    sax_grid_sums[2u * i + 1u] = 0u;
}
