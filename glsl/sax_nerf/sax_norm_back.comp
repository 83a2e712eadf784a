#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Backward pass of a layer normalisation of the Lineformer with its parallel path: to = slope (added + gradient through the
// normalisation from SAX_BY_NORMAL). The slope is that of the activation before, if there is one. The kernel also writes each
// sample's gradients of the scales and the shifts. One invocation per sample of the chunk.
#include "inc/operands.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push {
    uint n_samples; uint capacity; uint from; uint added; uint to; uint scales; uint left; uint activation;
} push;
READ_VEC4(0, B0, sax_params);
READ_VEC4(1, B1, sax_operands);
layout(binding = 2) writeonly buffer B2 { vec4 sax_vectors[]; };
#include "inc/lineformer.glsl"

void main() {
    uint s = gl_GlobalInvocationID.x;
    if (s >= push.n_samples) return;
    vec4 x[WIDTH4], by[WIDTH4];
    [[unroll]] for (uint i = 0u; i < WIDTH4; i++) x[i] = operand(push.from, i, s);
    vec2 moments = moments_of(x);
    vec4 sum = vec4(0.0), along = vec4(0.0);
    [[unroll]] for (uint i = 0u; i < WIDTH4; i++) {
        vec4 hat = (x[i] - moments.x) * moments.y, d = operand(SAX_BY_NORMAL, i, s);
        sax_vectors[place_of(push.left, i, s)] = d * hat;
        sax_vectors[place_of(push.left + 1u, i, s)] = d;
        by[i] = d * FETCH(sax_params, push.scales + i);
        sum += by[i];
        along += by[i] * hat;
    }
    float mean = dot(sum, vec4(1.0 / 32.0)), share = dot(along, vec4(1.0 / 32.0));
    [[unroll]] for (uint i = 0u; i < WIDTH4; i++) {
        vec4 hat = (x[i] - moments.x) * moments.y;
        vec4 d = operand(push.added, i, s) + moments.y * (by[i] - mean - share * hat);
        if (push.activation == SAX_LEAKY) d *= leaky_slope(x[i]);
        sax_vectors[place_of(push.to, i, s)] = d;
    }
}
