#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Backward pass of the Lineformer's last layer: the gradient with respect to the input of the layer before, through its
// activation, from the gradient with respect to the line integrals. The kernel also writes each sample's gradients of the last
// layer's weights and bias. One invocation per sample of the chunk, whose first sample has index `first` among all samples.
#include "inc/operands.glsl"
#include "inc/sax_layout.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_samples; uint capacity; uint first; } push;
READ_VEC4(0, B0, sax_params);
READ_VEC4(1, B1, sax_operands);
layout(binding = 2) writeonly buffer B2 { vec4 sax_vectors[]; };
layout(binding = 3) uniform B3 { SaxSetup sax_setup; };
layout(binding = 4) readonly buffer B4 { vec4 sax_points[]; };
layout(binding = 5) readonly buffer B5 { float sax_ray_gradient[]; };
layout(binding = 6) readonly buffer B6 { float sax_sigma[]; };
#include "inc/lineformer.glsl"

void main() {
    uint s = gl_GlobalInvocationID.x;
    if (s >= push.n_samples) return;
    uint at = push.first + s;
    float sigma = sax_sigma[at];
    float d = sax_ray_gradient[at / sax_setup.n_samples] * sax_points[at].w * sigma * (1.0 - sigma);
    [[unroll]] for (uint i = 0u; i < WIDTH4; i++) {
        vec4 x = operand(SAX_X3, i, s);
        sax_vectors[place_of(SAX_DENSITY, i, s)] = d * x;
        sax_vectors[place_of(SAX_DENSITY + 1u, i, s)] = i == 0u ? vec4(d, 0.0, 0.0, 0.0) : vec4(0.0);
        sax_vectors[place_of(SAX_BY_JOINT, i, s)] = d * FETCH(sax_params, LINEFORMER_DENSITY + i) * leaky_slope(x);
    }
}
