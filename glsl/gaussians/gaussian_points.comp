#version 450
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_control_flow_attributes : require
// Attenuation of the dynamic field's Gaussians at the cells of a volume's rows, or a bound of its values at all points within a
// distance `away`. One workgroup per 64 cells of rows (x) and four rows (y), one invocation per cell of each row. A device that
// reads a Gaussian separately in each lane thus reads it once for four cells.
//   volume[row][n_dynamic_samples]; row: index of the ray in the batch. Reference implementation: reference::blobs.
// `ROWS` is the number of rows of a workgroup.
#ifndef ROWS
#define ROWS 4u
#endif
#include "inc/layout.glsl"
#include "inc/gaussian_layout.glsl"
#include "inc/random.glsl"
#include "inc/depths.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
// `away`: distance in world units; above 0 for an upper bound of the sum within it, below 0 for a lower bound.
layout(push_constant) uniform Push { uint first_row; uint n_rows; uint first_blob; uint n_blobs; float away; } push;
layout(binding = 0) uniform B0 { Setup setup; };
layout(binding = 1) readonly buffer B1 { Ray rays[]; };
layout(binding = 2) readonly buffer B2 { Blob blobs[]; };
layout(binding = 3) writeonly buffer B3 { float volume[]; };
#include "inc/blobs.glsl"

float density_at(Blob b, vec3 w, float moved) {
    float q = dot(w, blob_times(b, w));
    if (moved != 0.0) {
        float nearest = max(sqrt(max(q, 0.0)) - moved, 0.0);
        q = nearest * nearest;
    }
    return q < b.cut ? b.density * exp(-0.5 * q) : 0.0;
}

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint n = setup.n_dynamic_samples;
    uint k = gl_GlobalInvocationID.x;
    uint first = gl_WorkGroupID.x * 64u, last = min(first + 63u, n - 1u);
    float low = grid_depth(first, n, setup.dynamic_near, setup.dynamic_far);
    float high = grid_depth(last, n, setup.dynamic_near, setup.dynamic_far);
    float own = grid_depth(min(k, n - 1u), n, setup.dynamic_near, setup.dynamic_far);
    uint row = push.first_row + gl_WorkGroupID.y * ROWS;
    vec3 anchors[ROWS], directions[ROWS], cells[ROWS];
    float sums[ROWS];
    [[unroll]] for (uint j = 0u; j < ROWS; j++) {
        Ray ray = rays[min(row + j, push.n_rows - 1u)];
        anchors[j] = ray.anchor;
        directions[j] = ray.direction;
        cells[j] = ray.anchor + own * ray.direction;
        sums[j] = 0.0;
    }
    for (uint begin = 0u; begin < push.n_blobs; begin += 64u) {
        bool near = false;
        if (begin + lane < push.n_blobs) {
            Blob b = blobs[push.first_blob + begin + lane];
            float reach = 1.01 * b.reach + max(push.away, 0.0);
            [[unroll]] for (uint j = 0u; j < ROWS; j++) {
                vec3 along = directions[j];
                float depth = clamp(dot(b.centre - anchors[j], along) / dot(along, along), low, high);
                near = near || distance(b.centre, anchors[j] + depth * along) <= reach;
            }
        }
        mark_near(near);
        for (uint word = 0u; word < 2u; word++) {
            for (uint bits = near_blobs[word]; bits != 0u; bits &= bits - 1u) {
                Blob b = blobs[push.first_blob + begin + 32u * word + uint(findLSB(bits))];
                float moved = push.away == 0.0 ? 0.0 : push.away * stretch_of(b);
                [[unroll]] for (uint j = 0u; j < ROWS; j++) sums[j] += density_at(b, cells[j] - b.centre, moved);
            }
        }
    }
    if (k >= n) return;
    [[unroll]] for (uint j = 0u; j < ROWS; j++)
        if (row + j < push.n_rows) volume[(row + j) * n + k] = sums[j];
}
