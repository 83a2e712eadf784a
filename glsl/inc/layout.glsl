// Structures and numbers shared with the host: build.rs makes Rust's from them, comments included.
// Lengths are world units (100 mm); depths are measured from the isocentre plane along the
// source-detector axis, which keeps f32 points exact to 1e-7 where it matters.

const uint SAMPLE_GROUP = 64u;    // live samples are padded to whole workgroups of the passes over them

// What stays fixed during a run.
struct Setup {
    vec3 static_min;            // lower corner of the static field's box
    float static_near;          // first depth of the static field
    vec3 static_max;            // upper corner of the static field's box
    float static_far;           // last depth of the static field
    vec3 dynamic_min;           // lower corner of the dynamic field's box
    float dynamic_near;         // first depth of the dynamic field
    vec3 dynamic_max;           // upper corner of the dynamic field's box
    float dynamic_far;          // last depth of the dynamic field
    vec3 encode_centre;         // encoded coordinate = (x - centre) * scale
    float encode_scale;         // see `encode_centre`
    vec3 hull_min;              // lower corner of the motion hull
    float hull_inv_cell;        // 1 / side of a cell of the hull
    uvec3 hull_size;            // cells of the hull along each axis
    uint hull_phase_words;      // words from one phase's hull to the next; 0: one hull for all
    uint hull_enabled;          // 1: there is a hull
    uint seed;                  // of all random numbers
    uint n_rays;                // rays of a batch
    uint n_motion_rays;         // first rays of a batch, drawn from the first of listed_rays
    uint n_all_rays;            // training rays: frames x pixels
    uint n_motion_list;         // rays of listed_rays that meet the hull; they come first
    uint n_shown_list;          // rays of listed_rays behind them, which the others are drawn from; 0: from all training rays
    uint n_pixels;              // pixels of one image
    uint image_width;           // columns of an image
    uint n_phases;              // cardiac phases
    uint n_static_samples;      // depths per ray, static field
    uint n_dynamic_samples;     // depths per ray, dynamic field
    uint jitter;                // 0: depths on a regular grid (evaluation)
    uint per_ray_depths;        // 0: one set of depths for all rays of an iteration
    uint n_bands;               // frequency bands of the encoding
    uint grid;                  // cells per axis of planes and lines
    uint rank4;                 // vec4 per plane texel: ranks rounded up to 4
    float static_shift;         // sigma_l = gain * softplus(feature + shift)
    float static_gain;          // see `static_shift`
    float dynamic_shift;        // sigma_s = gain * softplus(feature + shift)
    float dynamic_gain;         // see `dynamic_shift`
    float least_slope;          // of sigma_s by its feature, where a ray asks for more; 0: as the softplus has it
    float static_weight;        // 1 / (mean integral)^2, 1 without normalisation
    float dynamic_weight;       // weight of a squared residual of the dynamic field
    float robust_scale;         // residuals of the dynamic field beyond this count linearly; 0: squared
    uint temporal_target;       // 1: the dynamic field is driven by temporal differences
    float occlusion_weight;     // of the integral of samples that are near
    float occlusion_depth;      // samples nearer than this are penalised
    float occlusion_share;      // share of the batch's last ray within which samples are penalised instead; 0: by depth
    uint occupancy_cells;       // cells per axis of the occupancy learned while training; 0: none
    uint occupancy_start;       // iterations before it is heeded
    float occupancy_threshold;  // attenuation up to which a sample is empty
    uint sample_capacity;       // samples one chunk can hold
    uint latent_width;          // numbers of a latent
    uint n_layers;              // hidden layers
    uint mlp_width;             // neurons of a hidden layer
    uint static_params;         // parameters of the static field come first
    uint n_params;              // all parameters
    uint fixed_point_bits;      // scale of the static gradient's 64-bit accumulators
    float tv_plane;             // weight of the planes' total variation
    float tv_line;              // weight of the lines' total variation
    float beta1;                // decay of Adam's first moments
    float beta2;                // decay of Adam's second moments
    float epsilon;              // Adam's smallest denominator
    uint ring_length;           // iterations whose reports are kept
    uint two_networks;          // 1: the static field is a network, too; gradients differ from sample to sample (loss_samples)
    uint along_axis;            // 1: path lengths are counted along the source-detector axis, not along the ray
    float change_weight;        // a ray weighs 1 + change_weight * ray.change
    float least_change;         // of a ray, beyond which its entropy counts whatever it sees
    float least_integral;       // of the dynamic field, from which the entropy of a ray counts
    uint stop_after;            // iterations after which a vanished entropy ends learning; 0: none does
    float stop_below;           // entropy that has vanished
};

// How Adam updates the parameters of a field in an iteration, which is update t since its moments were zero.
struct FieldUpdate {
    float rate;                 // learning rate
    uint restart;               // 1: moments are zero before this update
    float bias_correction1;     // 1 - beta1^t
    float bias_correction2;     // 1 - beta2^t
};

// One row per iteration, made on the host from the schedules.
struct Schedule {
    FieldUpdate static_update;  // of the static field
    FieldUpdate dynamic_update; // of the dynamic field
    float window;               // open frequency bands, may be fractional
    uint dynamic_active;        // 0: the dynamic field is delayed
    float favour_static;        // weight of the entropy of the fields' shares at samples
    float ray_entropy;          // weight of the entropy of the dynamic field along rays
    float near_integral;        // weight of the dynamic field's integral over near samples, two networks
    float static_size;          // weight of the static field's integrals and their squares
};

// What the device counts from iteration to iteration.
struct DeviceState {
    uint step;                  // iterations done
    float loss_scale;           // factor on gradients in f16; 1 on the f32 path
    uint overflowed;            // 1 while the gradient of an iteration is not finite
    uint good_updates;          // updates since the scale changed, that of a growth counted
    float return_scale;         // scale that is returned to quickly after overflows; 0: none yet
    uint stopped;               // 1: learning has ended
};

// What an iteration came to.
struct StepReport {
    float data;                 // weighted data terms
    float dynamic_data;         // weighted data term of the dynamic field alone
    float tv;                   // total variation, weighted
    float occlusion;            // occlusion, weighted
    float squared_error;        // mean squared residual of the total line integral
    uint live_samples;          // live dynamic samples of the batch
    uint step;                  // iterations done after it
    float loss_scale;           // factor on gradients in f16; 1 on the f32 path
    float favour_static;        // entropy of the fields' shares at samples, weighted
    float ray_entropy;          // entropy of the dynamic field along rays, weighted
    float static_size;          // the static field's integrals and their squares, weighted
    uint stopped;               // 1: learning has ended
};

// Live dynamic samples.
struct LiveSamples {
    uint count;                 // of the chunk
    uint padded;                // of the chunk, rounded up to SAMPLE_GROUP
    uint of_iteration;          // of the iteration so far
};

// Workgroups of a dispatch whose size the device chooses.
struct DispatchSize {
    uint x;                     // along x
    uint y;                     // along y
    uint z;                     // along z
};

// Sizes of the passes over live samples.
struct IndirectArguments {
    DispatchSize samples;         // one invocation per padded sample, in groups of SAMPLE_GROUP
    DispatchSize forward_tiles;   // one workgroup per tile of samples and of a layer's neurons
    DispatchSize backward_tiles;  // one workgroup per tile of samples and of a layer's inputs
};

// One ray: anchor is the point at the isocentre plane, direction has unit depth.
struct Ray {
    vec3 anchor;                // point at the isocentre plane
    uint phase;                 // cardiac phase nearest to when it was taken
    vec3 direction;             // towards the detector, of unit depth
    float norm;                 // path length per unit of depth
    float target;               // measured line integral
    float temporal_low;         // bounds of the integral above the pixel's static background
    uint id;                    // frame * pixels + pixel
    float temporal_high;        // see `temporal_low`
    uint beyond;                // phase on the other side of when it was taken
    float beyond_share;         // what it shows of that phase: 0 to 0.5
    float change;               // over the beat, of what passes at its pixel: 0 to 1 in each view
};

// Rays of a view as affine functions of pixel column and row.
struct View {
    vec4 anchor00;              // anchor of the first pixel
    vec4 anchor_du;             // its change from column to column
    vec4 anchor_dv;             // its change from row to row
    vec4 direction00;           // direction of the first pixel
    vec4 direction_du;          // its change from column to column
    vec4 direction_dv;          // its change from row to row
};

// What a rendering is of, beside its view.
struct Pose {
    uint first_pixel;           // of those that are drawn at once
    uint phase;                 // cardiac phase nearest to the time that is shown
    uint beyond;                // phase on the other side of that time
    float beyond_share;         // what is shown of that phase: 0 to 0.5
};

// One training image.
struct Frame {
    uint view;                  // of the training views
    uint phase;                 // cardiac phase nearest to when it was taken
    uint beyond;                // phase on the other side of when it was taken
    float beyond_share;         // what it shows of that phase: 0 to 0.5
    uint image_offset;          // floats into images
    uint background_offset;     // vec2 into backgrounds
};

// When a live sample's ray was taken.
struct SampleTime {
    uint phase;                 // nearest cardiac phase
    uint beyond;                // phase on the other side of that time
    float beyond_share;         // what is shown of that phase: 0 to 0.5
};

// What a ray sees.
struct RayOut {
    float static_integral;      // line integral of the static field
    float dynamic_integral;     // line integral of the dynamic field
    float occlusion;            // integral of the dynamic field's near samples
    float static_max;           // largest attenuation of the static field
    float dynamic_max;          // largest attenuation of the dynamic field
    float total_max;            // largest sum of both
};
