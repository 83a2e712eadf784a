#version 450
#extension GL_GOOGLE_include_directive : require
// Moments of the voxels near a Gaussian from which its gradient is computed: with h = dL/d(attenuation) times the Gaussian's
// value at a voxel, the sums of h, h c and h c c^T. Here c is the vector from the Gaussian's centre in standard deviations
// along its axes. One invocation per Gaussian, or several that share one.
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
layout(binding = 5) readonly buffer B5 { float r2_voxel_gradient[]; };
// [Gaussian][3]: (h c, h), (h cx^2, h cy^2, h cz^2, -), (h cx cy, h cx cz, h cy cz, -).
layout(binding = 6) writeonly buffer B6 { vec4 r2_voxel_moments[]; };

void main() {
    if (push.n_gaussians == 0u) return;
    uint i = min(splat_index(), push.n_gaussians - 1u);
    R2Gaussian g = r2_gaussians[i];
    vec3 corner = picture_turns[gaussian_step * r2_setup.n_sets + g.set].corner;
    vec3 scale = scale_of(g, gaussian_setup);
    R2Voxels near = voxels_of(g, scale, corner, r2_setup);
    uint n = n_voxels(near);
    mat3 axes = rotation_matrix(normalize(g.rotation));
    uint side = r2_setup.box_side, first = g.set * side * side * side;
    vec3 plain = vec3(0.0), linear = vec3(0.0), square = vec3(0.0), mixed = vec3(0.0);
    for (uint k = splat_lane(); k < n; k += lanes_per_splat) {
        uvec3 at = voxel_at(near, k);
        vec3 c = deviations(g, scale, axes, corner, at, r2_setup);
        float h = r2_voxel_gradient[first + index_of(at, r2_setup)] * exp(-0.5 * dot(c, c));
        plain.x += h;
        linear += h * c;
        square += h * c * c;
        mixed += h * vec3(c.x * c.y, c.x * c.z, c.y * c.z);
    }
    plain = splat_sum(plain);
    linear = splat_sum(linear);
    square = splat_sum(square);
    mixed = splat_sum(mixed);
    if (splat_lane() != 0u || splat_index() >= push.n_gaussians) return;
    float density = density_of(g);
    r2_voxel_moments[3u * i] = density * vec4(linear, plain.x);
    r2_voxel_moments[3u * i + 1u] = vec4(density * square, 0.0);
    r2_voxel_moments[3u * i + 2u] = vec4(density * mixed, 0.0);
}
