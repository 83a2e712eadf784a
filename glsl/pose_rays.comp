#version 450
#extension GL_GOOGLE_include_directive : require
// Rays of consecutive pixels of one pose, for rendering. One invocation per ray.
#include "inc/layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_pixel; uint n_rays; uint phase; uint image_width; uint view; } push;
layout(binding = 0) readonly buffer B0 { View views[]; };
layout(binding = 1) writeonly buffer B1 { Ray rays[]; };

void main() {
    uint r = gl_GlobalInvocationID.x;
    if (r >= push.n_rays) return;
    View view = views[push.view];
    uint pixel = push.first_pixel + r;
    float i = float(pixel % push.image_width);
    float j = float(pixel / push.image_width);
    Ray ray;
    ray.anchor = view.anchor00.xyz + i * view.anchor_du.xyz + j * view.anchor_dv.xyz;
    ray.phase = push.phase;
    ray.direction = view.direction00.xyz + i * view.direction_du.xyz + j * view.direction_dv.xyz;
    ray.norm = length(ray.direction);
    ray.target = 0.0;
    ray.temporal_low = 0.0;
    ray.id = pixel;
    ray.temporal_high = 0.0;
    rays[r] = ray;
}
