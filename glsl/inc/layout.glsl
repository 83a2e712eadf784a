// Structures shared with src/layout.rs, which asserts names and order against this file.
// Lengths are world units (100 mm); depths are measured from the isocentre plane along the
// source-detector axis, which keeps f32 points exact to 1e-7 where it matters.

struct Setup {
    uint seed;
    uint n_rays;              // rays of a batch
    uint n_motion_rays;       // first rays of a batch, drawn from motion_rays
    uint n_all_rays;          // training rays: frames x pixels
    uint n_motion_list;       // length of motion_rays
    uint n_pixels;            // pixels of one image
    uint image_width;
    uint n_phases;
    uint n_static_samples;    // depths per ray, static field
    uint n_dynamic_samples;   // depths per ray, dynamic field
    float static_near;
    float static_far;
    float dynamic_near;
    float dynamic_far;
    uint jitter;              // 0: depths on a regular grid (evaluation)
    uint per_ray_depths;      // 0: one set of depths for all rays of an iteration
    float static_min_x;
    float static_min_y;
    float static_min_z;
    float static_max_x;
    float static_max_y;
    float static_max_z;
    float dynamic_min_x;
    float dynamic_min_y;
    float dynamic_min_z;
    float dynamic_max_x;
    float dynamic_max_y;
    float dynamic_max_z;
    float encode_centre_x;
    float encode_centre_y;
    float encode_centre_z;
    float encode_scale;       // encoded coordinate = (x - centre) * scale
    uint n_bands;
    uint grid;                // cells per axis of planes and lines
    uint rank4;               // vec4 per plane texel: ranks rounded up to 4
    float static_shift;
    float static_gain;
    float dynamic_shift;
    float dynamic_gain;
    float static_weight;      // 1 / (mean integral)^2, 1 without normalisation
    float dynamic_weight;
    float robust_scale;       // residuals of the dynamic field beyond this count linearly; 0: squared
    uint temporal_target;     // 1: the dynamic field is driven by temporal differences
    float occlusion_weight;
    float occlusion_depth;    // samples nearer than this are penalised
    uint hull_enabled;
    uint hull_nx;
    uint hull_ny;
    uint hull_nz;
    float hull_min_x;
    float hull_min_y;
    float hull_min_z;
    float hull_inv_cell;
    uint hull_phase_words;    // words from one phase's hull to the next; 0: one hull for all
    uint occupancy_cells;     // cells per axis of the occupancy learned while training; 0: none
    uint occupancy_start;     // iterations before it is heeded
    float occupancy_threshold;  // attenuation up to which a sample is empty
    uint sample_capacity;     // samples one chunk can hold
    uint latent_width;
    uint n_layers;            // hidden layers
    uint mlp_width;
    uint static_params;       // parameters of the static field come first
    uint n_params;
    uint fixed_point_bits;    // scale of the static gradient's 64-bit accumulators
    float tv_plane;
    float tv_line;
    float beta1;
    float beta2;
    float epsilon;
    uint ring_length;
};

// One row per iteration, made on the host from the schedules.
struct Schedule {
    float static_lr;
    float dynamic_lr;
    float window;             // open frequency bands, may be fractional
    uint dynamic_active;
    uint reset;               // optimiser state is re-created before this iteration
    float bias_correction1;
    float bias_correction2;
    uint spare;
};

// One ray: anchor is the point at the isocentre plane, direction has unit depth.
struct Ray {
    vec3 anchor;
    uint phase;
    vec3 direction;
    float norm;
    float target;             // measured line integral
    float temporal_low;       // bounds of the integral above the pixel's still background
    uint id;
    float temporal_high;
};

struct View {
    vec4 anchor00;
    vec4 anchor_du;
    vec4 anchor_dv;
    vec4 direction00;
    vec4 direction_du;
    vec4 direction_dv;
};

struct Frame {
    uint view;
    uint phase;
    uint image_offset;        // floats into images
    uint background_offset;   // vec2 into backgrounds
};

// What a ray sees.
struct RayOut {
    float static_integral;
    float dynamic_integral;
    float occlusion;
    float static_max;
    float dynamic_max;
    float total_max;
    float spare0;
    float spare1;
};
