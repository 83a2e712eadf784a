// Counter-based random numbers: pcg4d (Jarzynski and Olano, "Hash Functions for GPU Rendering", JCGT 2020).

uvec4 pcg4d(uvec4 v) {
    v = v * 1664525u + 1013904223u;
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    v ^= v >> 16u;
    v.x += v.y * v.w;
    v.y += v.z * v.x;
    v.z += v.x * v.y;
    v.w += v.y * v.z;
    return v;
}

// Streams of random numbers. The streams of the host are listed here, too, so that each is used only once.
const uint STREAM_DEPTH = 1u;         // depth jitter
const uint STREAM_RAY = 2u;           // order of all training rays
const uint STREAM_MOTION_RAY = 3u;    // order of the rays that meet the hull
const uint STREAM_INIT = 4u;          // initial parameters
const uint STREAM_PHOTON = 5u;        // photon noise of phantoms
const uint STREAM_SHAPE = 6u;         // shape variation of phantoms
const uint STREAM_OCCUPANCY = 7u;     // selection of the empty cells that are evaluated again
const uint STREAM_PLACE = 8u;         // selection of the cells of the hull in which Gaussians begin
const uint STREAM_JITTER = 9u;        // position in its cell at which a Gaussian begins
const uint STREAM_ACQUISITION = 10u;  // acquisition of the runs of phantoms
const uint STREAM_SET_IMAGE = 11u;    // order of the images of a set of a static method of Gaussians
const uint STREAM_BOX = 12u;       // position of the box of voxels whose total variation counts
const uint STREAM_CHILD = 13u;     // positions of the children of a Gaussian that is split
const uint STREAM_WINDOW = 14u;   // selection of the windows of an image in SAX-NeRF

// Uniform random number in [0, 1) with 24 bits.
float uniform01(uint seed, uint stream, uint a, uint b) {
    return float(pcg4d(uvec4(seed, stream, a, b)).x >> 8u) * (1.0 / 16777216.0);
}

// Element `index` of a pseudo-random permutation of [0, n): a balanced Feistel network on the next even number of bits,
// repeated until its result is in the range.
uint permute(uint index, uint n, uint seed, uint epoch, uint stream) {
    uint half_bits = 1u;
    while ((1u << (2u * half_bits)) < n && half_bits < 16u) half_bits++;
    uint mask = (1u << half_bits) - 1u;
    uint x = index;
    do {
        uint left = x >> half_bits;
        uint right = x & mask;
        for (uint round = 0u; round < 4u; round++) {
            uint mixed = pcg4d(uvec4(right, seed ^ (stream << 28u), epoch, round)).x & mask;
            uint next = left ^ mixed;
            left = right;
            right = next;
        }
        x = (left << half_bits) | right;
    } while (x >= n);
    return x;
}
