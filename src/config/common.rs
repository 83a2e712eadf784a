//! Sections that all methods share.

use crate::calibrate::settings::CalibrateMode;
use crate::config::section::section;

section! {
    /// The training loop.
    Train, "train" {
        /// Length of the run; schedules refer to it.
        iterations: u32 in 1.0 to 1e6,
        /// Maximum number of samples evaluated at once. It bounds device memory and does not affect results. A device may allow
        /// fewer.
        chunk_samples: u32 in 1024.0 to 1_048_576.0,
        /// Iterations handed to the device at once.
        iterations_per_submit: u32 in 1.0 to 256.0,
        /// Iterations between checkpoints.
        checkpoint_every: u32 in 1.0 to 1e6,
        /// Iterations between validations; 0 turns them off.
        validate_every: u32,
        /// Loss, as a multiple of the first loss after a start, at which a run stops as diverged; 0 = never. A loss that is not
        /// finite always stops the run; a loss of 1e6 times the first one causes a warning.
        #[serde(default)] stop_at_loss_ratio: f64 in 0.0 to 1e30,
    }
}

section! {
    /// Self-calibration: corrections of the views' stated geometry, estimated from the angiograms before the fit.
    Calibrate, "calibrate" {
        /// Corrections to be estimated; absent from older checkpoints.
        #[serde(default)] mode: CalibrateMode,
    }
}

section! {
    /// Rendering.
    Render, "march" {
        /// Depths per ray of fields that rays are marched through.
        render_samples: u32 in 2.0 to 4096.0,
    }
}
