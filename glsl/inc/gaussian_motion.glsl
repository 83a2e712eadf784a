// Positions of the Gaussians of the deformable set. The including file must declare `gaussian_setup`, `deformable_setup`,
// `motion_grid`, `own_motion` and `motion_basis`.
#include "inc/phase_beyond.glsl"

// Position in an image taken `after_phase` after a phase: a linear interpolation between the positions at that phase and at the
// second phase.
vec3 position_at(uint i, vec3 rest, uint phase, float after_phase) {
    vec3 place = on_grid(rest, deformable_setup);
    uvec3 first = uvec3(floor(place));
    uint n_nodes = deformable_setup.n_nodes * deformable_setup.n_nodes * deformable_setup.n_nodes;
    uint beyond = phase_beyond(phase, after_phase);
    float share = abs(after_phase);
    vec3 x = rest;
    for (uint corner = 0u; corner < 8u; corner++) {
        uvec3 node = first + uvec3(corner & 1u, (corner >> 1) & 1u, corner >> 2);
        uint at = node_index(node, deformable_setup);
        vec3 way = motion_grid[phase * n_nodes + at].xyz;
        if (share > 0.0) way = mix(way, motion_grid[beyond * n_nodes + at].xyz, share);
        x += node_share(place, node) * way;
    }
    for (uint k = 0u; k < deformable_setup.n_basis; k++) {
        float weight = motion_basis[phase * deformable_setup.n_basis + k];
        if (share > 0.0) weight = mix(weight, motion_basis[beyond * deformable_setup.n_basis + k], share);
        x += weight * own_motion[i * deformable_setup.n_basis + k].xyz;
    }
    return x;
}
