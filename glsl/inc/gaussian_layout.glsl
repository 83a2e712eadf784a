// Structures of the Gaussians that shaders share with the host: build.rs generates the Rust structures from them, including the
// comments. Lengths are in pixels at the isocentre; line integrals are relative to the strongest change in the views.

// One Gaussian: attenuation exp(log_density - |diag(1 / scale) R^T (x - position)|^2 / 2).
struct Gaussian {
    vec3 position;              // Centre in world axes.
    float log_density;          // Logarithm of the attenuation at the centre, in shares of the strongest change per pixel.
    vec3 log_scale;             // Logarithms of the standard deviations along its own axes.
    uint phase;                 // Cardiac phase to which it belongs.
    vec4 rotation;              // Quaternion (w, x, y, z) of its axes; its length does not matter.
};

// A view. The depth of a point, its depth times column and its depth times row are the products of the three rows with (x, 1).
// Rays have the direction d0 + column du + row dv, of unit depth.
struct GaussianView {
    vec4 depth;                 // Row of the projection that gives the depth.
    vec4 column;                // Row of the projection that gives depth times column.
    vec4 row;                   // Row of the projection that gives depth times row.
    vec4 d0;                    // Direction of the ray of pixel (0, 0), of unit depth, followed by 1 / |det (d0, du, dv)|.
    vec4 du;                    // Change of the direction per column, followed by the time after the phase, in phases.
    vec4 dv;                    // Change of the direction per row.
};

// Constants of a fit of Gaussians.
struct GaussianSetup {
    uint n_views;               // Number of training views.
    uint n_phases;              // Number of cardiac phases.
    uint width;                 // Number of columns of an image.
    uint height;                // Number of rows of an image.
    float cut;                  // Distance in standard deviations at which a Gaussian is cut.
    float min_scale;          // Minimum of a standard deviation.
    float max_scale;       // Maximum of a standard deviation.
    float fixed_point;          // Number of units of the integer sums per unit of line integral.
    float bend;                 // Residual at which the loss changes from quadratic to linear.
    float loss_weight;          // Factor of the loss.
    float beta1;                // Decay of Adam's first moments.
    float beta2;                // Decay of Adam's second moments.
    float epsilon;              // Constant that Adam adds to its denominators.
    float position_rate;        // Adam's rate of positions.
    float scale_rate;           // Adam's rate of log-scales.
    float rotation_rate;        // Adam's rate of quaternions.
    float density_rate;         // Adam's rate of log-densities.
    uint ring_length;           // Number of losses in the ring buffer.
    uint n_images;              // Number of images.
    uint image_stride;          // Number of elements per image: its pixels, padded to groups of four.
    uint n_loss_parts;          // Number of partial sums of the loss.
    float blur;                 // Blur of images and Gaussians for motion tracking; gradients of scales do not include it.
};

// Row of the schedule of a fit of Gaussians; there is one per iteration.
struct GaussianSchedule {
    float rate;                 // Factor of all rates.
    float bias1;                // Bias correction 1 - beta1^t.
    float bias2;                // Bias correction 1 - beta2^t.
};

// Displacement grid of a deformable set of Gaussians, and the regularisation of its motion.
struct MotionGridSetup {
    uint n_nodes;               // Number of nodes along each axis of a cube around the isocentre.
    float half_side;            // Half side of the cube, pixels.
    float inverse_step;         // Number of node distances per pixel.
    uint n_basis;               // Number of coefficients per axis of a Gaussian's own motion.
    float smoothness;           // Weight of the penalty on squared differences of neighbouring nodes.
    float own_penalty;          // Weight of the penalty on squared own motion.
    float grid_rate;            // Adam's rate of displacements.
    float own_rate;             // Adam's rate of own motion.
    uint rest_phase;            // Cardiac phase at which Gaussians are at their stored positions.
};

// A Gaussian in an image: q = a du^2 + 2 b du dv + c dv^2, value = amplitude exp(-q / 2) within the box.
struct Splat {
    vec2 mean;                  // Column and row of the centre.
    vec2 half_box;              // Half sides of the box to which it is cut, pixels.
    vec3 conic;                 // Inverse variance: a, b and c.
    float amplitude;            // Line integral at the centre.
};

// A Gaussian of the dynamic field at a phase, as it is drawn, in world units (100 mm).
struct Blob {
    vec3 centre;                // Centre in world units.
    float density;              // Attenuation at the centre, per world unit.
    vec3 diagonal;              // Diagonal of the inverse variance: xx, yy, zz.
    float reach;                // Distance from the centre beyond which its value is zero.
    vec3 mixed;                 // Mixed elements of the inverse variance: xy, xz, yz.
    float cut;                  // Squared distance in standard deviations at which it is cut.
};
