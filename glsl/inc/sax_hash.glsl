// The hash grid of SAX-NeRF: which entries a point lies between, and its shares of them. Needs `SaxLevel`.

struct SaxCell {
    uvec3 corner;               // the lower one
    vec3 share;                 // of the upper one along each axis
};

// Where a point of the unit cube lies in a level. Exact to the last bit, since fine levels have half a million cells:
// no multiplication may be joined with an addition.
SaxCell cell_at(SaxLevel level, vec3 unit) {
    precise vec3 scaled = unit * float(level.cells - 1u);
    precise vec3 position = scaled + 0.5;
    vec3 corner = floor(position);
    return SaxCell(uvec3(corner), position - corner);
}

// The entry of a corner, counted over all levels.
uint entry_of(SaxLevel level, uvec3 corner) {
    uint side = level.cells + 1u;
    uint index = level.dense != 0u ? corner.x + side * (corner.y + side * corner.z)
                                   : corner.x ^ (corner.y * 19349663u) ^ (corner.z * 83492791u);
    return level.first + index % level.entries;
}

// Entry and share of one of a cell's eight corners.
uint tap(SaxLevel level, SaxCell cell, uint corner, out float share) {
    uvec3 upper = uvec3(corner & 1u, (corner >> 1u) & 1u, corner >> 2u);
    vec3 shares = mix(1.0 - cell.share, cell.share, vec3(upper));
    share = shares.x * shares.y * shares.z;
    return entry_of(level, cell.corner + upper);
}
