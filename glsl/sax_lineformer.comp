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
layout(binding = 3) readonly buffer B3 { SaxStep sax_steps[]; };
layout(binding = 4) writeonly buffer B4 { float sax_sigma[]; };
#include "inc/lineformer.glsl"

void main() {
    uint pairs = (push.row + 1u) / 2u, ray = invocation() / pairs, k = 2u * (invocation() % pairs);
    if (ray >= push.n_rays) return;
    uint s = ray * push.row + k, other = min(k + 1u, push.row - 1u) - k;
    clear_vectors();
    [[dont_unroll]] for (uint i = 0u; i < input4(); i++) {
        vectors[at(SAX_FEATURES) + i] = sax_encoding[i * push.n_rays * push.row + s];
        vectors[at(SAX_FEATURES) + WIDTH4 + i] = sax_encoding[i * push.n_rays * push.row + s + other];
    }
    [[dont_unroll]] for (uint k = 0u; k < sax_setup.n_forward_steps; k++) take_forward(sax_steps[k]);
    vec2 sigma = push.scale * density();
    sax_sigma[push.first_out + s] = sigma.x;
    if (other != 0u) sax_sigma[push.first_out + s + 1u] = sigma.y;
}
