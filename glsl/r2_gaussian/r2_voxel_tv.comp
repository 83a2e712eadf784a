#version 450
#extension GL_GOOGLE_include_directive : require
// Total variation of each set's box of s^3 voxels, which is the mean of |difference| over the 3 (s - 1) s^2 pairs of
// neighbours, and its gradient with respect to each voxel. One invocation per voxel (x) and set (y).
#include "inc/gaussian_layout.glsl"
#include "inc/r2_layout.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/reduce.glsl"
layout(push_constant) uniform Push { uint first_part; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { R2Setup r2_setup; };
// [set][z][y][x] in fixed point.
layout(binding = 2) readonly buffer B2 { int r2_voxel_sums[]; };
// [set][z][y][x]
layout(binding = 3) writeonly buffer B3 { float r2_voxel_gradient[]; };
// Partial sum of the loss of each workgroup, from `first_part` on.
layout(binding = 4) writeonly buffer B4 { float gaussian_loss_parts[]; };

void main() {
    uint k = gl_GlobalInvocationID.x, set = gl_WorkGroupID.y, side = r2_setup.box_side;
    uint n = side * side * side, at = set * n + k;
    float variation = 0.0;
    float weight = r2_setup.tv_weight / (3.0 * float(side - 1u) * float(side * side));
    if (k < n) {
        int here = r2_voxel_sums[at], slope = 0;
        uvec3 place = uvec3(k % side, k / side % side, k / (side * side));
        uint stride = 1u;
        for (int axis = 0; axis < 3; axis++) {
            if (place[axis] > 0u) slope += sign(here - r2_voxel_sums[at - stride]);
            if (place[axis] + 1u < side) {
                int step = r2_voxel_sums[at + stride] - here;
                slope -= sign(step);
                variation += abs(float(step));
            }
            stride *= side;
        }
        r2_voxel_gradient[at] = weight * float(slope);
    }
    float total = workgroup_sum(gaussian_setup.loss_weight * weight * variation / gaussian_setup.fixed_point);
    if (gl_LocalInvocationID.x == 0u)
        gaussian_loss_parts[push.first_part + set * gl_NumWorkGroups.x + gl_WorkGroupID.x] = total;
}
