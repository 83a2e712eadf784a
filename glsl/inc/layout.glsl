// Structures and constants that shaders share with the host: build.rs generates the Rust structures from them, including the
// comments. Lengths are in world units (100 mm). Depths are measured from the isocentre plane along the source-detector axis,
// so that the error of f32 points near the isocentre is about 1e-7.

const uint SAMPLE_GROUP = 64u;    // Workgroup size of passes over live samples, which are padded to its multiples.

// Constants of a run.
struct Setup {
    vec3 static_min;            // Lower corner of the static field's box.
    float static_near;          // First depth of the static field.
    vec3 static_max;            // Upper corner of the static field's box.
    float static_far;           // Last depth of the static field.
    vec3 dynamic_min;           // Lower corner of the dynamic field's box.
    float dynamic_near;         // First depth of the dynamic field.
    vec3 dynamic_max;           // Upper corner of the dynamic field's box.
    float dynamic_far;          // Last depth of the dynamic field.
    vec3 encode_centre;         // Centre of the encoding: encoded coordinate = (x - centre) * scale.
    float encode_scale;         // Scale of the encoding, see `encode_centre`.
    vec3 hull_min;              // Lower corner of the motion hull.
    float hull_inv_cell;        // Inverse side of a cell of the hull.
    uvec3 hull_size;            // Number of cells of the hull along each axis.
    uint hull_phase_words;      // Number of words from one phase's hull to the next; 0: one hull for all phases.
    uint hull_enabled;          // Flag: 1 if there is a motion hull.
    uint seed;                  // Seed of all random numbers.
    uint n_rays;                // Number of rays of a batch.
    uint n_motion_rays;         // Number of rays at the start of a batch, drawn from the first part of `listed_rays`.
    uint n_all_rays;            // Number of training rays: frames x pixels.
    uint n_motion_list;         // Number of rays in the first part of `listed_rays`, which meet the hull.
    uint n_shown_list;          // Number of rays in the second part, from which the other rays are drawn; 0: from all.
    uint n_pixels;              // Number of pixels of an image.
    uint image_width;           // Number of columns of an image.
    uint n_phases;              // Number of cardiac phases.
    uint n_static_samples;      // Number of depths per ray of the static field.
    uint n_dynamic_samples;     // Number of depths per ray of the dynamic field.
    uint jitter;                // Flag: 0 for depths on a regular grid (evaluation).
    uint per_ray_depths;        // Flag: 0 if all rays of an iteration have equal depths.
    uint n_bands;               // Number of frequency bands of the encoding.
    uint grid;                  // Number of cells per axis of planes and lines.
    uint rank4;                 // Number of vec4 per plane texel: ranks rounded up to a multiple of 4.
    float static_shift;         // Shift of the static field: sigma_l = gain * softplus(feature + shift).
    float static_gain;          // Gain of the static field, see `static_shift`.
    float dynamic_shift;        // Shift of the dynamic field: sigma_s = gain * softplus(feature + shift).
    float dynamic_gain;         // Gain of the dynamic field, see `dynamic_shift`.
    float min_slope;          // Minimum derivative of sigma_s by its feature where a ray needs more; 0: that of the softplus.
    float static_weight;        // Weight of a squared residual: 1 / (mean integral)^2, or 1 without normalisation.
    float dynamic_weight;       // Weight of a squared residual of the dynamic field.
    float robust_scale;         // Residual of the dynamic field above which the loss is linear; 0: the loss is quadratic.
    uint temporal_target;       // Flag: 1 if temporal differences are the target of the dynamic field.
    float occlusion_weight;     // Weight of the integral of near samples.
    float occlusion_depth;      // Depth below which samples are near.
    float occlusion_share;      // Share of the path of the batch's last ray in which samples are near; 0: `occlusion_depth`.
    uint occupancy_cells;       // Number of cells per axis of the occupancy learned during training; 0: no occupancy.
    uint occupancy_start;       // Number of iterations before the occupancy is used.
    float occupancy_threshold;  // Threshold of the attenuation, up to which a sample is empty.
    uint sample_capacity;       // Maximum number of samples of a chunk.
    uint latent_width;          // Number of elements of a latent.
    uint n_layers;              // Number of hidden layers.
    uint mlp_width;             // Number of neurons of a hidden layer.
    uint static_params;         // Number of parameters of the static field, which come first.
    uint n_params;              // Number of all parameters.
    uint fixed_point_bits;      // Fractional bits of the 64-bit sums of the static field's gradient.
    float tv_plane;             // Weight of the planes' total variation.
    float tv_line;              // Weight of the lines' total variation.
    float beta1;                // Decay of Adam's first moments.
    float beta2;                // Decay of Adam's second moments.
    float epsilon;              // Constant that Adam adds to its denominators.
    uint ring_length;           // Number of iterations whose reports are kept.
    uint two_networks;          // Flag: 1 if the static field is a network, too, with gradients per sample (`loss_samples`).
    uint along_axis;            // Flag: 1 if path lengths are along the source-detector axis instead of the ray.
    float change_weight;        // Factor of a ray's change in its weight 1 + change_weight * ray.change.
    float min_change;         // Threshold of a ray's change above which its entropy counts for any integral.
    float min_integral;       // Threshold of the dynamic field's integral from which a ray's entropy counts.
    uint stop_after;            // Number of iterations after which a vanished entropy stops training; 0: never.
    float stop_below;           // Threshold below which the entropy counts as vanished.
};

// Adam's update of a field's parameters in an iteration, which is update t since the moments were reset.
struct FieldUpdate {
    float rate;                 // Learning rate.
    uint restart;               // Flag: 1 if the moments are set to zero before this update.
    float bias_correction1;     // Bias correction 1 - beta1^t.
    float bias_correction2;     // Bias correction 1 - beta2^t.
};

// Row of the schedule, computed on the host; there is one per iteration.
struct Schedule {
    FieldUpdate static_update;  // Update of the static field.
    FieldUpdate dynamic_update; // Update of the dynamic field.
    float window;               // Number of open frequency bands, which may be fractional.
    uint dynamic_active;        // Flag: 0 while the dynamic field is delayed.
    float favour_static;        // Weight of the entropy of the fields' shares at samples.
    float ray_entropy;          // Weight of the entropy of the dynamic field along rays.
    float near_integral;        // Weight of the dynamic field's integral over near samples (two networks).
    float static_size;          // Weight of the static field's integrals and their squares.
};

// State that the device updates in each iteration.
struct DeviceState {
    uint step;                  // Number of completed iterations.
    float loss_scale;           // Factor of gradients in f16; 1 with f32.
    uint overflowed;            // Flag: 1 while the gradient of an iteration is not finite.
    uint good_updates;          // Number of updates since the scale changed, including the one at which it grew.
    float return_scale;         // Scale to which the loss scale returns quickly after overflows; 0: not set.
    uint stopped;               // Flag: 1 after training has stopped.
};

// Results of an iteration.
struct StepReport {
    float data;                 // Sum of the weighted data terms.
    float dynamic_data;         // Weighted data term of the dynamic field.
    float tv;                   // Weighted total variation.
    float occlusion;            // Weighted occlusion term.
    float squared_error;        // Mean squared residual of the total line integral.
    uint live_samples;          // Number of live samples of the dynamic field in the batch.
    uint step;                  // Number of completed iterations, including this one.
    float loss_scale;           // Factor of gradients in f16; 1 with f32.
    float favour_static;        // Weighted entropy of the fields' shares at samples.
    float ray_entropy;          // Weighted entropy of the dynamic field along rays.
    float static_size;          // Weighted sum of the static field's integrals and their squares.
    uint stopped;               // Flag: 1 after training has stopped.
};

// Numbers of live samples, at which the dynamic field is evaluated.
struct LiveSamples {
    uint count;                 // Number of live samples of the chunk.
    uint padded;                // Number of live samples of the chunk, rounded up to a multiple of SAMPLE_GROUP.
    uint of_iteration;          // Number of live samples of the iteration so far.
};

// Numbers of workgroups of a dispatch, computed on the device.
struct DispatchSize {
    uint x;                     // Number of workgroups along x.
    uint y;                     // Number of workgroups along y.
    uint z;                     // Number of workgroups along z.
};

// Sizes of the passes over live samples.
struct IndirectArguments {
    DispatchSize samples;         // Size with one invocation per padded sample, in groups of SAMPLE_GROUP.
    DispatchSize forward_tiles;   // Size with one workgroup per tile of samples and of a layer's neurons.
    DispatchSize backward_tiles;  // Size with one workgroup per tile of samples and of a layer's inputs.
};

// A ray, given by a point and a direction.
struct Ray {
    vec3 anchor;                // Point of the ray in the isocentre plane.
    uint phase;                 // Cardiac phase nearest to the acquisition time.
    vec3 direction;             // Direction towards the detector, of unit depth.
    float norm;                 // Path length per unit of depth.
    float target;               // Measured line integral.
    float temporal_low;         // Lower bound of the integral above the pixel's static background.
    uint id;                    // Index of the ray: frame * pixels + pixel.
    float temporal_high;        // Upper bound, see `temporal_low`.
    uint beyond;                // Phase on the other side of the acquisition time.
    float beyond_share;         // Share of the phase `beyond` in the ray: 0 to 0.5.
    float change;               // Change of the pixel's transmission over the beat: 0 to 1 in each view.
};

// Rays of a view as affine functions of pixel column and row.
struct View {
    vec4 anchor00;              // Anchor of the first pixel.
    vec4 anchor_du;             // Change of the anchor from column to column.
    vec4 anchor_dv;             // Change of the anchor from row to row.
    vec4 direction00;           // Direction of the first pixel.
    vec4 direction_du;          // Change of the direction from column to column.
    vec4 direction_dv;          // Change of the direction from row to row.
};

// Pixels and time of a rendering.
struct Pose {
    uint first_pixel;           // First pixel of those that are rendered at once.
    uint phase;                 // Cardiac phase nearest to the rendered time.
    uint beyond;                // Phase on the other side of that time.
    float beyond_share;         // Share of the phase `beyond` in the rendering: 0 to 0.5.
};

// One training image.
struct Frame {
    uint view;                  // Index of the training view.
    uint phase;                 // Cardiac phase nearest to the acquisition time.
    uint beyond;                // Phase on the other side of the acquisition time.
    float beyond_share;         // Share of the phase `beyond` in the image: 0 to 0.5.
    uint image_offset;          // Offset in `images`, in floats.
    uint background_offset;     // Offset in `backgrounds`, in vec2.
};

// Acquisition time of a live sample's ray.
struct SampleTime {
    uint phase;                 // Nearest cardiac phase.
    uint beyond;                // Phase on the other side of the acquisition time.
    float beyond_share;         // Share of the phase `beyond` in the ray: 0 to 0.5.
};

// Line integrals and maxima of a ray.
struct RayOut {
    float static_integral;      // Line integral of the static field.
    float dynamic_integral;     // Line integral of the dynamic field.
    float occlusion;            // Integral of the dynamic field's near samples.
    float static_max;           // Maximum attenuation of the static field.
    float dynamic_max;          // Maximum attenuation of the dynamic field.
    float total_max;            // Maximum sum of both.
};
