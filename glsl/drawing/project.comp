#version 450
#extension GL_GOOGLE_include_directive : require
// Line integrals through a voxel volume, with trilinear samples at the mid-points of equal depth steps between near and far.
// The volume is zero outside, and in blocks of 8^3 voxels that are not occupied, which the march leaves in one step. One invocation per pixel.
//   volume   : size.x * size.y * size.z, x first
//   occupied : 1 where a block, or a voxel next to its upper faces, edges or corner, is not zero; ceil(size / 8) blocks, x first
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
layout(binding = 2) readonly buffer B2 { uint occupied[]; };
layout(binding = 3) buffer B3 { float integrals[]; };

const float BLOCK = 8.0;

float voxel(ivec3 cell) {
    if (any(lessThan(cell, ivec3(0))) || any(greaterThanEqual(cell, ivec3(push.size)))) return 0.0;
    return volume[(uint(cell.z) * push.size.y + uint(cell.y)) * push.size.x + uint(cell.x)];
}

// A sample before the first voxel is interpolated with voxels of the first block.
vec3 block_of(vec3 index) { return floor(max(index, vec3(0.0)) / BLOCK); }

bool is_occupied(vec3 block) {
    uvec3 n = (push.size + uint(BLOCK) - 1u) / uint(BLOCK);
    uvec3 b = min(uvec3(block), n - 1u);
    return occupied[(b.z * n.y + b.y) * n.x + b.x] != 0u;
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
        uint k = k0;
        while (k < k1) {
            float t = push.near + (float(k) + 0.5) * depth_step;
            vec3 index = start + t * rate;
            vec3 block = block_of(index);
            k++;
            if (is_occupied(block)) {
                sum += trilinear(index);
            } else {
                // Rounded down: a sample at the face of the next block is looked at once more.
                vec3 faces = (block + step(0.0, safe_rate)) * BLOCK;
                vec3 ends = (faces - start) / safe_rate;
                float end = min(min(ends.x, ends.y), ends.z);
                k = max(k, uint(clamp(floor((end - push.near) / depth_step - 0.5), 0.0, float(k1))));
            }
        }
    }
    integrals[push.first_pixel + pixel] += push.scale * sum * depth_step * length(line.direction);
}
