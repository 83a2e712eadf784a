// Structures of X-Gaussian shared with the host: build.rs makes Rust's from them, comments included. Lengths are mm in
// fits, pixels at the isocentre where pictures are drawn of a model.

// A Gaussian as X-Gaussian stores it: its opacity is sigmoid(opacity), at its centre.
struct XGaussian {
    vec3 position;              // centre, along the world's axes
    float opacity;              // before the sigmoid
    vec3 log_scale;             // logs of the standard deviations along its own axes
    float intensity;            // what it shows; nothing below 0
    vec4 rotation;              // quaternion (w, x, y, z) of its axes; its length does not matter
};

// What stays fixed while the number of Gaussians does, beside GaussianSetup.
struct XSetup {
    float nearest;              // depth up to which nothing is seen
    uint n_sets;                // sets of Gaussians, each fitted by itself
    uint tile_columns;          // tiles of 16 x 16 pixels along a row of a picture
    uint tile_rows;             // along a column
    uint capacity;              // Gaussians in all tiles' lists that there is room for
    float absolute_weight;      // weight of the absolute difference in the loss
};

// Gaussians of a set, when all are sorted: by set, then by depth.
struct XSet {
    uint first;                 // place of the nearest
    uint count;                 // how many
};

// One row per iteration.
struct XSchedule {
    float position_rate;        // Adam's rate of positions
    float opacity_rate;         // of opacities
    float scale_rate;           // of logs of scales
    float intensity_rate;       // of intensities
    float rotation_rate;        // of quaternions
    float bias1;                // 1 - beta1^t of the t updates up to this one
    float bias2;                // 1 - beta2^t
    uint updates;               // 0: Gaussians are added and taken away after it, and no parameter is updated
};

// Tiles that a Gaussian may show in: column in the lower half of a word, row in the upper one.
struct XSpan {
    uint first;                 // first tile
    uint end;                   // one more than the last column and row
    uint first_entry;           // where its gradient in the first tile goes; those of others follow row by row
};

// What Gaussians are sorted by.
struct XKey {
    uint depth;                 // bits of the depth as f32, which are in its order; all set where it is not seen
    uint index;                 // the Gaussian
};

// A tile's list.
struct XList {
    uint first;                 // where it begins
    uint count;                 // its Gaussians, nearest first
};

// Where a pixel ends.
struct XEnd {
    float left;                 // share of light that passes all Gaussians
    uint last;                  // one more than the place in the list of the last that shows
};

// Counted anew in each iteration.
struct XCounts {
    uint entries;               // Gaussians in all tiles' lists
    uint listed;                // of those, how many have a place
};

// What the host asks after iterations.
struct XStatus {
    uint entries;               // Gaussians in all tiles' lists of the last one; beyond the capacity it did nothing
    uint step;                  // iterations done
};

// What density control goes by, since it came last.
struct XStatistics {
    float pull;                 // sum over iterations of the gradient by the centre, in half images
    float seen;                 // iterations in which a view saw it
    float radius;               // its largest radius in a picture, pixels
};
