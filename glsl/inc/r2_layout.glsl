// Structures of R2-Gaussian shared with the host: build.rs makes Rust's from them, comments included. Lengths are half
// sides of the volume, which is the cube from -1 to 1; densities are 1 where vessels attenuate as they are said to;
// line integrals are their product.

// A Gaussian as R2-Gaussian stores it: its density is softplus(density), a sigmoid keeps each scale between its bounds.
struct R2Gaussian {
    vec3 position;              // centre, along the world's axes
    float density;              // of the centre, before the softplus
    vec3 scale;                 // standard deviations along its own axes, before the sigmoid
    uint set;                   // set it belongs to: each has images of its own
    vec4 rotation;              // quaternion (w, x, y, z) of its axes; its length does not matter
};

// What stays fixed during a fit, beside GaussianSetup, whose lengths are half sides here, too.
struct R2Setup {
    uint n_sets;                // sets of Gaussians, each fitted by itself
    uint box_side;              // voxels along each side of the box whose total variation counts
    float voxel;                // side of a voxel
    float ssim_weight;          // weight of 1 - SSIM
    float tv_weight;            // weight of total variation
    uint tv_moves_centres;      // 1: the gradient of total variation moves Gaussians, too
    uint exact;                 // 1: line integrals are those along pixels' own rays, not of the affine picture
};

// One row per iteration.
struct R2Schedule {
    float position_rate;        // Adam's rate of positions
    float density_rate;         // Adam's rate of densities
    float scale_rate;           // Adam's rate of scales
    float rotation_rate;        // Adam's rate of quaternions
    float bias1;                // 1 - beta1^t of the t updates up to this one
    float bias2;                // 1 - beta2^t
    uint updates;               // 0: Gaussians are added and taken away after it, and no parameter is updated
};

// What a set sees in an iteration.
struct R2Turn {
    vec3 corner;                // centre of the first voxel of the box
    uint image;                 // training image
};
