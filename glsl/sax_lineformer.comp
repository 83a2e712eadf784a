#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Attenuation at samples by the Lineformer: rays of `row` samples are cut into pairs from their first on; the last of
// an odd number is a pair with itself. One invocation per pair.
//   sax_sigma[sample] = scale * density
#include "inc/sax_layout.glsl"
layout(local_size_x = 32, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_rays; uint row; uint first_out; float scale; } push;
layout(binding = 0) readonly buffer B0 { SaxSetup sax_setup; };
layout(binding = 1) readonly buffer B1 { vec4 sax_params[]; };
layout(binding = 2) readonly buffer B2 { vec4 sax_encoding[]; };
layout(binding = 3) writeonly buffer B3 { float sax_sigma[]; };
#include "inc/lineformer.glsl"

void main() {
    uint pairs = (push.row + 1u) / 2u, ray = invocation() / pairs, k = 2u * (invocation() % pairs);
    if (ray >= push.n_rays) return;
    uint s = ray * push.row + k, other = min(k + 1u, push.row - 1u) - k;
    Pair encoding = nothing();
    for (uint i = 0u; i < input4(); i++) {
        encoding.a[i] = sax_encoding[i * push.n_rays * push.row + s];
        encoding.b[i] = sax_encoding[i * push.n_rays * push.row + s + other];
    }
    Pair x = plus(vector_at(LINEFORMER_INPUT_BIAS), times(LINEFORMER_INPUT, input4(), input4(), encoding));
    x = leaky(x);
    vec2 inverse;
    Attention at = attend(affine(LINEFORMER_NORM1, normalised(x, inverse)));
    x = plus(x, plus(vector_at(LINEFORMER_OUT + 256u), times(LINEFORMER_OUT, WIDTH4, WIDTH4, at.seen)));
    Pair normal = affine(LINEFORMER_NORM2, normalised(x, inverse));
    Pair first[4];
    [[dont_unroll]] for (uint slice = 0u; slice < FFN_SLICES; slice++) first[slice] = gelu(expanded(slice, normal));
    [[dont_unroll]] for (uint slice = 0u; slice < FFN_SLICES; slice++)
        x = plus(x, times(contract_at(slice), FFN_STRIDE, WIDTH4, gelu(mixed(slice, first))));
    vec2 sigma = push.scale * density(leaky(joined(encoding, leaky(x))));
    sax_sigma[push.first_out + s] = sigma.x;
    if (other != 0u) sax_sigma[push.first_out + s + 1u] = sigma.y;
}
