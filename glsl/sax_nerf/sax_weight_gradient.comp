#version 450
#extension GL_GOOGLE_include_directive : require
// Gradient of the Lineformer's numbers: the sum of the workgroups' parts in their order. One invocation per number.
#include "inc/sax_layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(binding = 0) uniform B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { float sax_weight_parts[]; };  // [workgroup][number]
layout(binding = 2) writeonly buffer B2 { float gradient[]; };

void main() {
    uint i = invocation();
    if (i >= sax_setup.n_weights) return;
    float sum = 0.0;
    for (uint group = 0u; group < sax_setup.n_groups; group++) sum += sax_weight_parts[group * sax_setup.n_weights + i];
    gradient[i] = sum;
}
