// Hash grid of SAX-NeRF: the entries around a point, and their interpolation weights. The including file must declare
// `SaxLevel`.

struct SaxCell {
    uvec3 corner;               // lower corner of the cell
    vec3 share;                 // share of the upper corner along each axis
};

// Cell of a level that contains a point of the unit cube. The result must be exact to the last bit, because fine levels have
// half a million cells: a multiplication must not be fused with an addition.
SaxCell cell_at(SaxLevel level, vec3 unit) {
    precise vec3 scaled = unit * float(level.cells - 1u);
    precise vec3 position = scaled + 0.5;
    vec3 corner = floor(position);
    return SaxCell(uvec3(corner), position - corner);
}

// Entry of a corner, counted over all levels.
uint entry_of(SaxLevel level, uvec3 corner) {
    uint side = level.cells + 1u;
    uint index = level.dense != 0u ? corner.x + side * (corner.y + side * corner.z)
                                   : corner.x ^ (corner.y * 19349663u) ^ (corner.z * 83492791u);
    return level.first + index % level.entries;
}

// Entry of one of a cell's eight corners, and its interpolation weight.
uint tap(SaxLevel level, SaxCell cell, uint corner, out float share) {
    uvec3 upper = uvec3(corner & 1u, (corner >> 1u) & 1u, corner >> 2u);
    vec3 shares = mix(1.0 - cell.share, cell.share, vec3(upper));
    share = shares.x * shares.y * shares.z;
    return entry_of(level, cell.corner + upper);
}
