#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Attention of the Lineformer: the weighted mean of a sample's own values and the values of the other sample of its pair. One
// invocation per sample of the chunk.
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
    [[unroll]] for (uint head = 0u; head < WIDTH4; head++) {
        float share = own_share(operand(SAX_QUERY, head, s), operand(SAX_KEY, head, s), operand(SAX_KEY, head, pair.other),
                                FETCH(sax_params, LINEFORMER_POSITION + head), pair.is_second);
        vec4 seen = share * operand(SAX_VALUE, head, s) + (1.0 - share) * operand(SAX_VALUE, head, pair.other);
        sax_vectors[place_of(SAX_SEEN, head, s)] = seen;
    }
}
