#version 450
#extension GL_GOOGLE_include_directive : require
// Attenuation of the moving field's Gaussians at the cells of a volume's rows. One workgroup per 64 cells of a row (x)
// and row (y), one invocation per cell.
//   volume[row][n_dynamic_samples]; row = ray of the batch. Twin: reference::blobs.
#include "inc/layout.glsl"
#include "inc/gaussian_layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
layout(push_constant) uniform Push { uint first_row; uint first_blob; uint n_blobs; } push;
layout(binding = 0) readonly buffer B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { Ray rays[]; };
layout(binding = 2) readonly buffer B2 { Blob blobs[]; };
layout(binding = 3) writeonly buffer B3 { float volume[]; };
#include "inc/blobs.glsl"

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint n = setup.n_dynamic_samples;
    uint row = push.first_row + gl_WorkGroupID.y;
    Ray ray = rays[row];
    uint k = gl_GlobalInvocationID.x;
    uint first = gl_WorkGroupID.x * 64u, last = min(first + 63u, n - 1u);
    float low = grid_depth(first, n, setup.dynamic_near, setup.dynamic_far);
    float high = grid_depth(last, n, setup.dynamic_near, setup.dynamic_far);
    vec3 x = ray.anchor + grid_depth(min(k, n - 1u), n, setup.dynamic_near, setup.dynamic_far) * ray.direction;
    float squared = dot(ray.direction, ray.direction);
    float sum = 0.0;
    for (uint begin = 0u; begin < push.n_blobs; begin += 64u) {
        bool near = false;
        if (begin + lane < push.n_blobs) {
            Blob b = blobs[push.first_blob + begin + lane];
            float depth = dot(b.centre - ray.anchor, ray.direction) / squared;
            near = distance(b.centre, ray.anchor + clamp(depth, low, high) * ray.direction) <= 1.01 * b.reach;
        }
        mark_near(near);
        for (uint word = 0u; word < 2u; word++) {
            for (uint bits = near_blobs[word]; bits != 0u; bits &= bits - 1u) {
                Blob b = blobs[push.first_blob + begin + 32u * word + uint(findLSB(bits))];
                vec3 w = x - b.centre;
                float q = dot(w, blob_times(b, w));
                if (q < b.cut) sum += b.density * exp(-0.5 * q);
            }
        }
    }
    if (k < n) volume[row * n + k] = sum;
}
