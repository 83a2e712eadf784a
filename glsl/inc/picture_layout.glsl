// Structures of fits of sets of Gaussians to pictures, which shaders share with the host: build.rs generates the Rust structures from
// them, including the comments.

// Constants of the comparison of pictures with images.
struct PictureSetup {
    uint n_sets;                // Number of sets of Gaussians, each fitted separately.
    float ssim_weight;          // Weight of 1 - SSIM.
};

// Image and box of a set in an iteration.
struct PictureTurn {
    vec3 corner;                // Centre of the first voxel of the box whose total variation counts, for fits that have one.
    uint image;                 // Index of the training image.
};
