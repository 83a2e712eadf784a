#version 450
#extension GL_GOOGLE_include_directive : require
// Projects each Gaussian of X-Gaussian into the view that its set uses in this iteration: its splat, the tiles of 16 x 16
// pixels in which it may be visible, its depth, and the position of its gradients. It also counts the Gaussians of each tile.
// One invocation per Gaussian.
#include "inc/blend.glsl"
layout(local_size_x = 64, local_size_x_id = 0) in;
#include "inc/workgroup.glsl"
layout(push_constant) uniform Push { uint n_gaussians; } push;
layout(binding = 0) uniform B0 { GaussianSetup gaussian_setup; };
layout(binding = 1) uniform B1 { BlendSetup blend_setup; };
// View of each image.
layout(binding = 2) readonly buffer B2 { GaussianView gaussian_views[]; };
layout(binding = 3) readonly buffer B3 { BlendGaussian blend_gaussians[]; };
// Set of each Gaussian.
layout(binding = 4) readonly buffer B4 { uint blend_set_of[]; };
// [iteration][set]
layout(binding = 5) readonly buffer B5 { PictureTurn picture_turns[]; };
layout(binding = 6) readonly buffer B6 { uint gaussian_step; };
layout(binding = 7) writeonly buffer B7 { Splat splats[]; };
layout(binding = 8) writeonly buffer B8 { BlendSpan blend_spans[]; };
layout(binding = 9) writeonly buffer B9 { BlendKey blend_keys[]; };
// [set][tile row][tile column]
layout(binding = 10) buffer B10 { uint blend_tile_counts[]; };
layout(binding = 11) buffer B11 { BlendCounts blend_counts; };

shared uint n_entries[gl_WorkGroupSize.x];
shared uint first_of_all;

// Adds a Gaussian to the counts of the tiles from .xy to before .zw and returns the number of these tiles.
uint count_in(uvec4 tiles, uint set) {
    for (uint row = tiles.y; row < tiles.w; row++)
        for (uint column = tiles.x; column < tiles.z; column++)
            atomicAdd(blend_tile_counts[(set * blend_setup.tile_rows + row) * blend_setup.tile_columns + column], 1u);
    return (tiles.z - tiles.x) * (tiles.w - tiles.y);
}

void main() {
    uint i = invocation(), lane = gl_LocalInvocationID.x;
    bool exists = i < push.n_gaussians;
    uvec4 tiles = uvec4(0u);
    uint depth = UNSEEN, own = 0u;
    if (exists) {
        uint set = blend_set_of[i];
        GaussianView view = gaussian_views[picture_turns[gaussian_step * blend_setup.n_sets + set].image];
        BlendProjection p = project_blended(blend_gaussians[i], view, gaussian_setup, blend_setup);
        splats[i] = p.splat;
        tiles = tiles_of(p.splat, blend_setup);
        own = count_in(tiles, set);
        if (own > 0u) depth = floatBitsToUint(p.at.depth);
        blend_keys[i] = BlendKey(depth, i);
    }
    n_entries[lane] = own;
    barrier();
    uint before = 0u, all = 0u;
    for (uint k = 0u; k < gl_WorkGroupSize.x; k++) {
        if (k < lane) before += n_entries[k];
        all += n_entries[k];
    }
    // The positions depend on the order in which workgroups arrive, but the gradients do not depend on their positions.
    if (lane == 0u) first_of_all = atomicAdd(blend_counts.entries, all);
    barrier();
    if (exists) blend_spans[i] = BlendSpan(tiles.x | tiles.y << 16, tiles.z | tiles.w << 16, first_of_all + before);
}
