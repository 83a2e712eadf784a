// Structures of SAX-NeRF that shaders share with the host: build.rs generates the Rust structures from them, including the
// comments. Lengths are in world units. Attenuations are relative to the attenuation of vessels, per world unit.

// Constants of a fit or of a rendering.
struct SaxSetup {
    uint n_levels;              // Number of levels of the hash grid, which is even; each level has two features.
    float bound;                // Half side of the grid's box.
    float near;                 // First depth along rays.
    float far;                  // Last depth along rays.
    uint n_samples;             // Number of samples of a ray.
    uint jitter;                // Flag: 0 for depths on a regular grid (rendering).
    uint n_rays;                // Number of rays of a batch: rays of windows, followed by single ones.
    uint n_windows;             // Number of windows of a batch.
    uint window;                // Side of a window, pixels.
    uint width;                 // Number of columns of an image.
    uint height;                // Number of rows of an image.
    uint n_sets;                // Number of fields, each fitted separately.
    uint n_weights;             // Number of the Lineformer's parameters, which precede those of the grid.
    uint n_grid;                // Number of the grid's parameters.
    uint n_groups;              // Number of parts of a chunk's samples for the sums of the Lineformer's gradients.
    uint fixed_point_bits;      // Fractional bits of the sums of the grid's gradient.
    uint ring_length;           // Number of iterations whose losses are kept.
};

// A level of the hash grid.
struct SaxLevel {
    uint cells;                 // Number of cells along each side of the box.
    uint first;                 // Index of the first entry.
    uint entries;               // Number of entries.
    uint dense;                 // Flag: 1 if each corner of a cell has its own entry; 0 if corners share entries by their hash.
};

// Non-empty pixels of an image, from which single rays are drawn.
struct SaxList {
    uint first;                 // Position in the list of all images.
    uint n;                     // Number of pixels.
};

// Gradient of the Lineformer's numbers: the sum over samples of a product of two of their vectors, or of one vector.
struct SaxProduct {
    uint left;                  // Vector with a number for each row.
    uint right;                 // Vector with a number for each column.
    uint first;                 // Position of the first number, vec4.
    uint stride;                // Distance from row to row, vec4.
    uint columns;               // Number of columns, vec4; 0: the sum of `left` alone.
};
