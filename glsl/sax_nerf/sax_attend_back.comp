#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Backward pass of the Lineformer's attention: gradients with respect to a sample's query, key and values, from the results of
// both samples of its pair, and with respect to the position biases. One invocation per sample of the chunk.
#include "inc/operands.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_samples; uint capacity; uint first; uint row; } push;
READ_VEC4(0, B0, sax_params);
READ_VEC4(1, B1, sax_operands);
layout(binding = 2) writeonly buffer B2 { vec4 sax_vectors[]; };
#include "inc/lineformer.glsl"
#include "inc/sax_pairs.glsl"

void main() {
    uint s = gl_GlobalInvocationID.x;
    if (s >= push.n_samples) return;
    Pair pair = pair_of(s);
    uint o = pair.other;
    [[unroll]] for (uint head = 0u; head < WIDTH4; head++) {
        vec4 positions = FETCH(sax_params, LINEFORMER_POSITION + head);
        vec4 query = operand(SAX_QUERY, head, s), other_query = operand(SAX_QUERY, head, o);
        vec4 key = operand(SAX_KEY, head, s), other_key = operand(SAX_KEY, head, o);
        vec4 apart = operand(SAX_VALUE, head, s) - operand(SAX_VALUE, head, o);
        vec4 d = operand(SAX_BY_SEEN, head, s), other_d = operand(SAX_BY_SEEN, head, o);
        float share = own_share(query, key, other_key, positions, pair.is_second);
        float other_share = own_share(other_query, other_key, key, positions, !pair.is_second);
        // Derivatives with respect to the score of this sample's key minus that of the other key: for this sample and for the
        // other one.
        float by = share * (1.0 - share) * dot(d, apart);
        float other_by = other_share * (1.0 - other_share) * dot(other_d, apart);
        sax_vectors[place_of(SAX_BY_QUERY, head, s)] = 0.5 * by * (key - other_key);
        sax_vectors[place_of(SAX_BY_KEY, head, s)] = 0.5 * (by * query + other_by * other_query);
        sax_vectors[place_of(SAX_BY_VALUE, head, s)] = share * d + (1.0 - other_share) * other_d;
        sax_vectors[place_of(SAX_POSITION, head, s)] =
            pair.is_second ? vec4(0.0, 0.0, -by, by) : vec4(by, -by, 0.0, 0.0);
    }
}
