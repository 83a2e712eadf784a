#version 450
#extension GL_GOOGLE_include_directive : require
// Attenuation at the voxels of each set's box. Each Gaussian is added to the voxels near it in fixed-point integers, so that
// runs are bit-identical. One invocation per Gaussian, or several that share one, as in gaussian_splat.
#include "inc/r2.glsl"
#include "inc/r2_voxels.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/splat_lanes.glsl"
layout(push_constant) uniform Push { uint n_gaussians; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { R2Setup r2_setup; };
layout(binding = 2) readonly buffer B2 { R2Gaussian r2_gaussians[]; };
layout(binding = 3) readonly buffer B3 { PictureTurn picture_turns[]; };
layout(binding = 4) readonly buffer B4 { uint gaussian_step; };
// [set][z][y][x] in fixed point.
layout(binding = 5) buffer B5 { int r2_voxel_sums[]; };

void main() {
    uint i = splat_index();
    if (i >= push.n_gaussians) return;
    R2Gaussian g = r2_gaussians[i];
    vec3 corner = picture_turns[gaussian_step * r2_setup.n_sets + g.set].corner;
    vec3 scale = scale_of(g, gaussian_setup);
    R2Voxels near = voxels_of(g, scale, corner, r2_setup);
    uint n = n_voxels(near);
    if (n == 0u) return;
    mat3 axes = rotation_matrix(normalize(g.rotation));
    float density = density_of(g) * gaussian_setup.fixed_point;
    uint side = r2_setup.box_side, first = g.set * side * side * side;
    for (uint k = splat_lane(); k < n; k += lanes_per_splat) {
        uvec3 at = voxel_at(near, k);
        vec3 c = deviations(g, scale, axes, corner, at, r2_setup);
        atomicAdd(r2_voxel_sums[first + index_of(at, r2_setup)], int(roundEven(density * exp(-0.5 * dot(c, c)))));
    }
}
