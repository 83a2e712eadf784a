// Voxels of a set's box within reach of a Gaussian, and the Gaussian's values there. The including file must include
// "inc/r2.glsl". Reference implementation: src/methods/r2_gaussian/twin.rs.

// Distance in standard deviations along its longest axis at which a Gaussian is cut.
const float VOXEL_CUT = 3.0;

// Voxels of the box near a Gaussian: the first one, and their numbers along each axis.
struct R2Voxels {
    uvec3 first;
    uvec3 size;
};

R2Voxels voxels_of(R2Gaussian g, vec3 scale, vec3 corner, R2Setup setup) {
    float reach = VOXEL_CUT * max(scale.x, max(scale.y, scale.z));
    vec3 first = max(ceil((g.position - reach - corner) / setup.voxel), vec3(0.0));
    vec3 last = min(floor((g.position + reach - corner) / setup.voxel), vec3(float(setup.box_side) - 1.0));
    if (!all(lessThanEqual(first, last))) return R2Voxels(uvec3(0u), uvec3(0u));
    return R2Voxels(uvec3(first), uvec3(last) - uvec3(first) + 1u);
}

uint n_voxels(R2Voxels near) {
    return near.size.x * near.size.y * near.size.z;
}

// The k-th of these voxels, in an order in which x changes fastest.
uvec3 voxel_at(R2Voxels near, uint k) {
    uint row = k / near.size.x;
    return near.first + uvec3(k % near.size.x, row % near.size.y, row / near.size.y);
}

// Index of a voxel in the box.
uint index_of(uvec3 at, R2Setup setup) {
    return (at.z * setup.box_side + at.y) * setup.box_side + at.x;
}

// Vector from the centre to a voxel, in standard deviations along the Gaussian's axes.
vec3 deviations(R2Gaussian g, vec3 scale, mat3 axes, vec3 corner, uvec3 at, R2Setup setup) {
    return ((corner + setup.voxel * vec3(at) - g.position) * axes) / scale;
}
