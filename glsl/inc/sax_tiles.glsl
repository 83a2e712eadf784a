// Where samples of a tile leave their vectors, in vec4.
const uint TILE_SAMPLES = 64u;

uint vector_place(uint tile, uint vector) {
    return (tile * SAX_VECTORS + vector) * TILE_SAMPLES * 8u;
}
