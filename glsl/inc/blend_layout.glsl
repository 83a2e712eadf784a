// Structures of Gaussians of which nearer ones hide those behind them, which shaders share with the host: build.rs generates the Rust
// structures from them, including the comments. Lengths are in mm in fits, and in pixels at the isocentre where pictures of a model are drawn.

// A Gaussian as X-Gaussian stores it: the opacity at its centre is sigmoid(opacity).
struct BlendGaussian {
    vec3 position;              // Centre in world axes.
    float opacity;              // Opacity before the sigmoid.
    vec3 log_scale;             // Logarithms of the standard deviations along its own axes.
    float intensity;            // Intensity in pictures; values below 0 count as 0.
    vec4 rotation;              // Quaternion (w, x, y, z) of its axes; its length does not matter.
};

// Constants between changes of the number of Gaussians, in addition to GaussianSetup.
struct BlendSetup {
    float nearest;              // Depth up to which Gaussians are not visible.
    uint n_sets;                // Number of sets of Gaussians, each fitted separately.
    uint tile_columns;          // Number of tiles of 16 x 16 pixels along a row of a picture.
    uint tile_rows;             // Number of tiles along a column of a picture.
    uint capacity;              // Maximum number of Gaussians in all tiles' lists.
    float absolute_weight;      // Weight of the absolute difference in the loss.
};

// Range of a set's Gaussians among all Gaussians, which are sorted by set and then by depth.
struct BlendSet {
    uint first;                 // Position of the nearest Gaussian.
    uint count;                 // Number of Gaussians.
};

// Tiles in which a Gaussian may be visible; a word has the column in its lower half and the row in its upper half.
struct BlendSpan {
    uint first;                 // First tile.
    uint end;                   // End of the tiles: one more than the last column and row.
    uint first_entry;           // Position of its gradient in the first tile; the other tiles follow row by row.
};

// Sort key of a Gaussian.
struct BlendKey {
    uint depth;                 // Bits of the depth as f32, in the order of depths; all are set if it is not visible.
    uint index;                 // Index of the Gaussian.
};

// List of a tile's Gaussians.
struct BlendList {
    uint first;                 // Position of the first Gaussian.
    uint count;                 // Number of Gaussians, which are sorted from the nearest on.
};

// State of a pixel behind its last Gaussian.
struct BlendEnd {
    float left;                 // Transmittance of all its Gaussians.
    uint last;                  // One more than the position in the list of the last visible Gaussian.
};

// Counts that start from zero in each iteration.
struct BlendCounts {
    uint entries;               // Number of Gaussians in all tiles' lists.
    uint listed;                // Number of these Gaussians whose lists already have a position.
};
