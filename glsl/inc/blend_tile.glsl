// Tile of 16 x 16 pixels with four pixels in each of 64 lanes. The including file must declare `gaussian_setup` and `blend_setup`.
const uint LANES = 64u;
const uint PIXELS_OF_LANE = 4u;

// Position in blend_lists of the workgroup's tile: column (x), row (y) and set (z).
uint list_of_workgroup() {
    uvec3 at = gl_WorkGroupID;
    return (at.z * blend_setup.tile_rows + at.y) * blend_setup.tile_columns + at.x;
}

// The `k`-th pixel of the lane.
uvec2 pixel_of_lane(uint k) {
    uint p = k * LANES + gl_LocalInvocationID.x;
    return TILE * gl_WorkGroupID.xy + uvec2(p % TILE, p / TILE);
}

bool is_in_image(uvec2 pixel) {
    return pixel.x < gaussian_setup.width && pixel.y < gaussian_setup.height;
}

// Position of a pixel in the pictures.
uint place_of(uvec2 pixel) {
    return gl_WorkGroupID.z * gaussian_setup.image_stride + pixel.y * gaussian_setup.width + pixel.x;
}
