// Gaussians along the rays of a tile of 8 x 8 pixels, one invocation per ray. The including file must declare `push` and `rays`
// and include "inc/blobs.glsl" and "inc/reduce.glsl".

// First ray of a tile, and the maximum distance of the tile's other rays from it at depth 0 and per unit of depth.
struct Tile {
    Ray first;
    float spread;
    float spread_per_depth;
};

// Ray of this lane, or the tile's first ray if the lane's pixel is outside the image.
struct TileRay {
    Ray ray;
    uint index;
    bool wanted;
};

uvec2 tile_corner() {
    uint tiles = (push.image_width + 7u) / 8u;
    return 8u * uvec2(gl_WorkGroupID.x % tiles, gl_WorkGroupID.x / tiles);
}

TileRay ray_of_lane() {
    uint lane = gl_LocalInvocationID.x;
    uvec2 corner = tile_corner(), pixel = corner + uvec2(lane % 8u, lane / 8u);
    uint index = pixel.y * push.image_width + pixel.x;
    bool wanted = pixel.x < push.image_width && index < push.n_rays;
    return TileRay(rays[wanted ? index : corner.y * push.image_width + corner.x], index, wanted);
}

Tile tile_of(Ray ray) {
    uvec2 corner = tile_corner();
    Ray first = rays[corner.y * push.image_width + corner.x];
    float spread = workgroup_max(distance(ray.anchor, first.anchor));
    return Tile(first, spread, workgroup_max(distance(ray.direction, first.direction)));
}

// Whether any ray of the tile may meet a Gaussian.
bool is_near(Blob b, Tile tile) {
    vec3 w = b.centre - tile.first.anchor;
    float depth = dot(w, tile.first.direction) / dot(tile.first.direction, tile.first.direction);
    float away = length(w - depth * tile.first.direction);
    // The nearest points of other rays are not at the depth of the first ray; the factor 1.1 covers this difference.
    return away <= b.reach + 1.1 * (tile.spread + (abs(depth) + b.reach) * tile.spread_per_depth);
}

// Gaussian along a ray: height exp(-steepness (depth - at)^2 / 2). The height is 0 where the ray passes outside the cut.
struct Profile {
    float at;
    float steepness;
    float height;
};

Profile profile_of(Blob b, Ray ray) {
    vec3 w = b.centre - ray.anchor;
    // The vector starts at the ray's point nearest to the centre, so that its components are small.
    float depth = dot(w, ray.direction) / dot(ray.direction, ray.direction);
    w -= depth * ray.direction;
    vec3 along = blob_times(b, ray.direction);
    float steepness = dot(ray.direction, along);
    float offset = dot(w, along) / steepness;
    float q = max(dot(w, blob_times(b, w)) - offset * offset * steepness, 0.0);
    return Profile(depth + offset, steepness, q < b.cut ? b.density * exp(-0.5 * q) : 0.0);
}
