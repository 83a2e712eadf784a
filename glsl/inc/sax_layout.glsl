// Structures of SAX-NeRF shared with the host: build.rs makes Rust's from them, comments included. Lengths are world
// units; attenuations are shares of what vessels attenuate, per world unit.

// What stays fixed of a fit, or of what is drawn.
struct SaxSetup {
    uint n_levels;              // levels of the hash grid, an even number; each has two features
    float bound;                // half side of the grid's box
    float near;                 // first depth along rays
    float far;                  // last depth along rays
    uint n_samples;             // samples of a ray
    uint jitter;                // 0: depths on a regular grid (drawing)
    uint n_rays;                // rays of a batch: those of windows, then single ones
    uint n_windows;             // windows of a batch
    uint window;                // side of a window, pixels
    uint width;                 // columns of an image
    uint height;                // rows of an image
    uint n_sets;                // fields, each fitted by itself
    uint n_weights;             // numbers of the Lineformer, which come before those of the grid
    uint n_grid;                // numbers of the grid
    uint n_groups;              // parts that a chunk of samples is cut into for sums of the Lineformer's gradients
    uint fixed_point_bits;      // behind the point, of the grid's gradient
    uint ring_length;           // iterations whose losses are kept
};

// A level of the hash grid.
struct SaxLevel {
    uint cells;                 // along each side of the box
    uint first;                 // entry it begins with
    uint entries;               // entries it has
    uint dense;                 // 1: an entry for each corner of each cell; 0: corners share entries by their hash
};

// Pixels of an image that single rays are drawn from: those that show something.
struct SaxList {
    uint first;                 // place in the list of all images
    uint n;                     // how many
};

// A gradient of numbers of the Lineformer: the sum over samples of a product of two vectors that they leave, or of one.
struct SaxProduct {
    uint left;                  // vector that has a number for each row
    uint right;                 // vector that has one for each column
    uint first;                 // where the numbers begin, vec4
    uint stride;                // from row to row, vec4
    uint columns;               // vec4; 0: a sum of `left` alone
};
