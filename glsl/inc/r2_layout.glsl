// Structures of R2-Gaussian that shaders share with the host: build.rs generates the Rust structures from them, including the
// comments. Lengths are in half sides of the volume, which is the cube from -1 to 1. A density of 1 is the given attenuation of
// vessels, and line integrals are products of these units.

// A Gaussian as R2-Gaussian stores it: its density is softplus(density), and a sigmoid keeps each scale within its bounds.
struct R2Gaussian {
    vec3 position;              // Centre in world axes.
    float density;              // Density at the centre, before the softplus.
    vec3 scale;                 // Standard deviations along its own axes, before the sigmoid.
    uint set;                   // Set to which it belongs; each set has its own images.
    vec4 rotation;              // Quaternion (w, x, y, z) of its axes; its length does not matter.
};

// Constants of a fit in addition to GaussianSetup, whose lengths are in half sides of the volume here, too.
struct R2Setup {
    uint n_sets;                // Number of sets of Gaussians, each fitted separately.
    uint box_side;              // Number of voxels along each side of the box whose total variation counts.
    float voxel;                // Side of a voxel.
    float tv_weight;            // Weight of the total variation.
    uint tv_moves_centres;      // Flag: 1 if the gradient of the total variation includes the centres.
    uint exact;                 // Flag: 1 for line integrals along pixels' own rays, 0 for those of the affine picture.
};

// Row of the schedule; there is one per iteration.
struct R2Schedule {
    float position_rate;        // Adam's rate of positions.
    float density_rate;         // Adam's rate of densities.
    float scale_rate;           // Adam's rate of scales.
    float rotation_rate;        // Adam's rate of quaternions.
    float bias1;                // Bias correction 1 - beta1^t after t updates, including this one.
    float bias2;                // Bias correction 1 - beta2^t.
    uint updates;               // Flag: 0 if Gaussians are added and pruned after this iteration and no parameter is updated.
};
