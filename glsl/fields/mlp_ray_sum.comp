#version 450
#extension GL_GOOGLE_include_directive : require
// Sums dz over the samples of each ray: ray_dz[q * n_rays + ray]. One invocation per (ray, 4 neurons).
#include "inc/layout.glsl"
#include "inc/operands.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_rays; uint capacity; } push;
READ_VEC4(0, B0, dz);
layout(binding = 1) readonly buffer B1 { uint ray_start[]; };
layout(binding = 2) writeonly buffer B2 { vec4 ray_dz[]; };

void main() {
    uint r = gl_GlobalInvocationID.x;
    uint q = gl_WorkGroupID.y;
    if (r >= push.n_rays) return;
    vec4 sum = vec4(0.0);
    uint end = ray_start[r + 1u];
    for (uint s = ray_start[r]; s < end; s++) sum += FETCH(dz, q * push.capacity + s);
    ray_dz[q * push.n_rays + r] = sum;
}
