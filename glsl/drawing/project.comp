#version 450
#extension GL_GOOGLE_include_directive : require
// Line integrals through a voxel volume, with trilinear samples at the mid-points of equal depth steps between near and far.
// The volume is zero outside. One invocation per pixel.
//   integrals[first_pixel + pixel] += scale * sum sigma * path length
#include "inc/layout.glsl"
#include "inc/pixel_ray.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push {
    vec4 row_x; vec4 row_y; vec4 row_z;   // world units -> voxel index
    uvec3 size; uint view;
    float near; float far; uint steps; float scale;
    uint image_width; uint n_pixels; uint first_pixel;
} push;
layout(binding = 0) readonly buffer B0 { View views[]; };
layout(binding = 1) readonly buffer B1 { float volume[]; };
layout(binding = 2) buffer B2 { float integrals[]; };

float voxel(ivec3 cell) {
    if (any(lessThan(cell, ivec3(0))) || any(greaterThanEqual(cell, ivec3(push.size)))) return 0.0;
    return volume[(uint(cell.z) * push.size.y + uint(cell.y)) * push.size.x + uint(cell.x)];
}

float trilinear(vec3 index) {
    vec3 base = floor(index);
    vec3 f = index - base;
    ivec3 c = ivec3(base);
    vec4 low = vec4(voxel(c), voxel(c + ivec3(1, 0, 0)), voxel(c + ivec3(0, 1, 0)), voxel(c + ivec3(1, 1, 0)));
    c.z += 1;
    vec4 high = vec4(voxel(c), voxel(c + ivec3(1, 0, 0)), voxel(c + ivec3(0, 1, 0)), voxel(c + ivec3(1, 1, 0)));
    vec4 plane = mix(low, high, f.z);
    vec2 line = mix(plane.xy, plane.zw, f.y);
    return mix(line.x, line.y, f.x);
}

void main() {
    uint pixel = invocation();
    if (pixel >= push.n_pixels) return;
    Line line = line_through(views[push.view], pixel, push.image_width);
    // The march is in index space. It is restricted to the depths at which the ray is inside the volume.
    vec3 start = vec3(dot(push.row_x.xyz, line.anchor) + push.row_x.w, dot(push.row_y.xyz, line.anchor) + push.row_y.w,
                      dot(push.row_z.xyz, line.anchor) + push.row_z.w);
    vec3 rate = vec3(dot(push.row_x.xyz, line.direction), dot(push.row_y.xyz, line.direction),
                     dot(push.row_z.xyz, line.direction));
    vec3 size = vec3(push.size);
    vec3 safe_rate = mix(rate, vec3(1e-12), lessThan(abs(rate), vec3(1e-12)));
    vec3 t0 = (vec3(-1.0) - start) / safe_rate;
    vec3 t1 = (size - start) / safe_rate;
    vec3 enter = min(t0, t1);
    vec3 leave = max(t0, t1);
    float first = max(max(enter.x, enter.y), max(enter.z, push.near));
    float last = min(min(leave.x, leave.y), min(leave.z, push.far));
    float depth_step = (push.far - push.near) / float(push.steps);
    float sum = 0.0;
    if (last > first) {
        uint k0 = uint(max(floor((first - push.near) / depth_step - 0.5), 0.0));
        uint k1 = min(uint(max(ceil((last - push.near) / depth_step), 0.0)), push.steps);
        for (uint k = k0; k < k1; k++) {
            float t = push.near + (float(k) + 0.5) * depth_step;
            sum += trilinear(start + t * rate);
        }
    }
    integrals[push.first_pixel + pixel] += push.scale * sum * depth_step * length(line.direction);
}
