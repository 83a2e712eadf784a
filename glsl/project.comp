#version 450
#extension GL_GOOGLE_include_directive : require
// Line integrals through a voxel volume: one invocation per pixel, trilinear samples at mid-points of
// equal depth steps between near and far, zero outside.
//   integrals[first_pixel + pixel] += scale * sum sigma * path length
#include "inc/layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push {
    vec4 row_x; vec4 row_y; vec4 row_z;   // world units -> voxel index
    uint nx; uint ny; uint nz; uint view;
    float near; float far; uint steps; float scale;
    uint image_width; uint n_pixels; uint first_pixel; uint spare;
} push;
layout(binding = 0) readonly buffer B0 { View views[]; };
layout(binding = 1) readonly buffer B1 { float volume[]; };
layout(binding = 2) buffer B2 { float integrals[]; };

float voxel(ivec3 cell) {
    if (any(lessThan(cell, ivec3(0))) || any(greaterThanEqual(cell, ivec3(push.nx, push.ny, push.nz)))) return 0.0;
    return volume[(uint(cell.z) * push.ny + uint(cell.y)) * push.nx + uint(cell.x)];
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
    uint pixel = gl_GlobalInvocationID.x;
    if (pixel >= push.n_pixels) return;
    View view = views[push.view];
    float i = float(pixel % push.image_width);
    float j = float(pixel / push.image_width);
    vec3 anchor = view.anchor00.xyz + i * view.anchor_du.xyz + j * view.anchor_dv.xyz;
    vec3 direction = view.direction00.xyz + i * view.direction_du.xyz + j * view.direction_dv.xyz;
    // March in index space; skip to the slab where the ray meets the volume.
    vec3 start = vec3(dot(push.row_x.xyz, anchor) + push.row_x.w, dot(push.row_y.xyz, anchor) + push.row_y.w,
                      dot(push.row_z.xyz, anchor) + push.row_z.w);
    vec3 rate = vec3(dot(push.row_x.xyz, direction), dot(push.row_y.xyz, direction), dot(push.row_z.xyz, direction));
    vec3 size = vec3(push.nx, push.ny, push.nz);
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
    integrals[push.first_pixel + pixel] += push.scale * sum * depth_step * length(direction);
}
