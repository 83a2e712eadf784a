#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Attenuation from the Lineformer's last layer, which is the scale times a sigmoid. One invocation per sample of the chunk.
//   sax_sigma[first_out + sample]
#include "inc/operands.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_samples; uint capacity; uint first_out; float scale; } push;
READ_VEC4(0, B0, sax_params);
READ_VEC4(1, B1, sax_operands);
layout(binding = 2) writeonly buffer B2 { float sax_sigma[]; };
#include "inc/lineformer.glsl"

void main() {
    uint s = gl_GlobalInvocationID.x;
    if (s >= push.n_samples) return;
    float sum = FETCH(sax_params, LINEFORMER_DENSITY + WIDTH4).x;
    [[unroll]] for (uint i = 0u; i < WIDTH4; i++)
        sum += dot(FETCH(sax_params, LINEFORMER_DENSITY + i), operand(SAX_X3, i, s));
    sax_sigma[push.first_out + s] = push.scale / (1.0 + exp(-sum));
}
