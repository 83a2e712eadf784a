// Structures of X-Gaussian that shaders share with the host: build.rs generates the Rust structures from them, including the
// comments.

// Row of the schedule; there is one per iteration.
struct XSchedule {
    float position_rate;        // Adam's rate of positions.
    float opacity_rate;         // Adam's rate of opacities.
    float scale_rate;           // Adam's rate of log-scales.
    float intensity_rate;       // Adam's rate of intensities.
    float rotation_rate;        // Adam's rate of quaternions.
    float bias1;                // Bias correction 1 - beta1^t after t updates, including this one.
    float bias2;                // Bias correction 1 - beta2^t.
    uint updates;               // Flag: 0 if Gaussians are added and pruned after this iteration and no parameter is updated.
};

// Status that the host reads after iterations.
struct XStatus {
    uint entries;               // Number of Gaussians in the last iteration's lists; above the capacity it had no effect.
    uint step;                  // Number of completed iterations.
};

// Statistics of a Gaussian since the last density control.
struct XStatistics {
    float pull;                 // Sum over iterations of the norm of the gradient by the centre, in half images.
    float seen;                 // Number of iterations in which it was visible.
    float radius;               // Maximum radius in a picture, pixels.
};
