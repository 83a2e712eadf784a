#version 450
#extension GL_GOOGLE_include_directive : require
// Rays of consecutive pixels of one pose, for rendering. One invocation per ray.
#include "inc/layout.glsl"
#include "inc/pixel_ray.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint n_rays; uint image_width; uint along_axis; } push;
layout(binding = 0) readonly buffer B0 { View views[]; };
layout(binding = 1) readonly buffer B1 { Pose pose; };
layout(binding = 2) writeonly buffer B2 { Ray rays[]; };

void main() {
    uint r = gl_GlobalInvocationID.x;
    if (r >= push.n_rays) return;
    uint pixel = pose.first_pixel + r;
    Line line = line_through(views[0], pixel, push.image_width);
    Ray ray;
    ray.anchor = line.anchor;
    ray.phase = pose.phase;
    ray.direction = line.direction;
    ray.norm = push.along_axis != 0u ? 1.0 : length(line.direction);
    ray.target = 0.0;
    ray.temporal_low = 0.0;
    ray.id = pixel;
    ray.temporal_high = 0.0;
    ray.beyond = pose.beyond;
    ray.beyond_share = pose.beyond_share;
    ray.change = 0.0;
    rays[r] = ray;
}
