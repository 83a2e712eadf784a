#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Layer normalisation of the Lineformer: each sample's 32 numbers minus their mean, divided by their standard deviation, times
// scales, plus shifts. One invocation per sample of the chunk.
#include "inc/operands.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_samples; uint capacity; uint from; uint to; uint scales; } push;
READ_VEC4(0, B0, sax_params);
READ_VEC4(1, B1, sax_operands);
layout(binding = 2) writeonly buffer B2 { vec4 sax_vectors[]; };
#include "inc/lineformer.glsl"

void main() {
    uint s = gl_GlobalInvocationID.x;
    if (s >= push.n_samples) return;
    vec4 x[WIDTH4];
    [[unroll]] for (uint i = 0u; i < WIDTH4; i++) x[i] = operand(push.from, i, s);
    vec2 moments = moments_of(x);
    [[unroll]] for (uint i = 0u; i < WIDTH4; i++) {
        vec4 hat = (x[i] - moments.x) * moments.y;
        sax_vectors[place_of(push.to, i, s)] =
            FETCH(sax_params, push.scales + i) * hat + FETCH(sax_params, push.scales + WIDTH4 + i);
    }
}
