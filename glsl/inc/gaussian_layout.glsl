// Structures of the Gaussians shared with the host: build.rs makes Rust's from them, comments included.
// Lengths are pixels at the isocentre, line integrals shares of the views' strongest change.

// One Gaussian: attenuation exp(log_density - |diag(1 / scale) R^T (x - position)|^2 / 2).
struct Gaussian {
    vec3 position;              // centre, along the world's axes
    float log_density;          // log of the attenuation at the centre, shares of the strongest change per pixel
    vec3 log_scale;             // logs of the standard deviations along its own axes
    uint phase;                 // cardiac phase it belongs to
    vec4 rotation;              // quaternion (w, x, y, z) of its axes; its length does not matter
};

// A view: homogeneous (depth, column, row) of a point are the rows' products with (x, 1); rays run along
// d0 + column du + row dv, of unit depth.
struct GaussianView {
    vec4 depth;                 // row of the projection that gives the depth
    vec4 column;                // row that gives depth times column
    vec4 row;                   // row that gives depth times row
    vec4 d0;                    // direction of pixel (0, 0)'s ray, of unit depth; then 1 / |det (d0, du, dv)|
    vec4 du;                    // its change per column; then how long after its phase the image was taken, in phases
    vec4 dv;                    // its change per row
};

// What stays fixed during a fit of Gaussians.
struct GaussianSetup {
    uint n_views;               // training views
    uint n_phases;              // cardiac phases
    uint width;                 // columns of an image
    uint height;                // rows of an image
    float cut;                  // standard deviations at which a Gaussian ends
    float least_scale;          // least standard deviation
    float greatest_scale;       // greatest standard deviation
    float fixed_point;          // units of the integer sums per unit of line integral
    float bend;                 // where the loss bends from square to linear
    float loss_weight;          // factor on the loss
    float beta1;                // decay of Adam's first moments
    float beta2;                // decay of Adam's second moments
    float epsilon;              // Adam's smallest denominator
    float position_rate;        // Adam's rate of positions
    float scale_rate;           // Adam's rate of log-scales
    float rotation_rate;        // Adam's rate of quaternions
    float density_rate;         // Adam's rate of log-densities
    uint ring_length;           // losses kept
    uint n_images;              // images
    uint image_stride;          // numbers from one image to the next: pixels, filled up to groups of four
    uint n_loss_parts;          // partial sums of the loss
    float blur;                 // of images and Gaussians, for tracking motion; gradients of scales do not know of it
};

// One row per iteration of a fit of Gaussians.
struct GaussianSchedule {
    float rate;                 // factor on all rates
    float bias1;                // 1 - beta1^t
    float bias2;                // 1 - beta2^t
};

// The grid of displacements of a deformable set, and what keeps its motion plain.
struct DeformableSetup {
    uint n_nodes;               // nodes along each axis of a cube around the isocentre
    float half_side;            // half the cube's side
    float inverse_step;         // nodes per pixel
    uint n_basis;               // numbers per axis of a Gaussian's own motion
    float smoothness;           // penalty on squared differences of neighbouring nodes
    float own_penalty;          // penalty on squared own motion
    float grid_rate;            // Adam's rate of displacements
    float own_rate;             // Adam's rate of own motion
    uint rest_phase;            // cardiac phase at which Gaussians are where their positions say
};

// A Gaussian in an image: q = a du^2 + 2 b du dv + c dv^2, value = amplitude exp(-q / 2) within the box.
struct Splat {
    vec2 mean;                  // column and row of the centre
    vec2 half_box;              // half sides of the box it is cut to
    vec3 conic;                 // a, b and c: the inverse variance
    float amplitude;            // line integral at the centre
};

// A Gaussian of the moving field as it is at a phase, in world units (100 mm): what is drawn.
struct Blob {
    vec3 centre;                // in world units
    float density;              // attenuation at the centre, per world unit
    vec3 diagonal;              // of the inverse variance: xx, yy, zz
    float reach;                // no point further away belongs to it
    vec3 mixed;                 // of the inverse variance: xy, xz, yz
    float cut;                  // squared standard deviations at which it ends
};
