//! Sections of a configuration: each hyper-parameter with its meaning and accepted range. Sections that all methods share stand here, those
//! of a method beside its presets.

pub use crate::config::dynamic_gaussians::{Deformable, Gaussians};
pub use crate::config::fields::{DynamicField, Hull, Loss, Occupancy, StaticField};
pub use crate::config::nerf_ca::Networks;
pub use crate::config::r2_gaussian::R2;
pub use crate::config::sax_nerf::Sax;
pub use crate::config::x_gaussian::X;

use crate::calibrate::settings::CalibrateMode;
use crate::config::forms::AdjustMode;
use crate::config::section::section;
use serde::{Deserialize, Serialize};

fn whole_run() -> f64 {
    1.0
}
section! {
    /// The training loop.
    Train, "train" {
        /// Length of the run; schedules refer to it.
        iterations: u32 in 1.0 to 1e6,
        /// Rays of a batch.
        rays: u32 in 1.0 to 65_535.0,
        /// Share of the batch drawn from rays that meet the motion hull; with two networks, from rays whose pixel changes.
        motion_share: f64 in 0.0 to 1.0,
        /// Maximum number of samples evaluated at once. It bounds device memory and does not affect results. A device may allow
        /// fewer.
        chunk_samples: u32 in 1024.0 to 1_048_576.0,
        /// Iterations handed to the device at once.
        iterations_per_submit: u32 in 1.0 to 256.0,
        /// Iterations between checkpoints.
        checkpoint_every: u32 in 1.0 to 1e6,
        /// Iterations between validations; 0 turns them off.
        validate_every: u32,
        /// Validation images used during training; evenly spread over all of them.
        validate_images: u32,
        /// Loss, as a multiple of the first loss after a start, at which a run stops as diverged; 0 = never. A loss that is not
        /// finite always stops the run; a loss of 1e6 times the first one causes a warning.
        #[serde(default)] stop_at_loss_ratio: f64 in 0.0 to 1e30,
    }
}

section! {
    /// Self-calibration: corrections of the views' stated geometry, estimated from the angiograms before the fit.
    Calibrate, "calibrate" {
        /// Corrections to be estimated.
        mode: CalibrateMode,
        /// Adjustment of angles, positions, breathing and contrasts with the Gaussians in the loop, after the calibration.
        #[serde(default)] adjust: AdjustMode,
    }
}

section! {
    /// Sampling along rays.
    March, "march" {
        /// Depths per ray for the static field.
        static_samples: u32 in 2.0 to 4096.0,
        /// Depths per ray for the dynamic field.
        dynamic_samples: u32 in 2.0 to 4096.0,
        /// Depths per ray when rendering.
        render_samples: u32 in 2.0 to 4096.0,
        /// Draw depths for each ray instead of once per iteration.
        per_ray_depths: bool,
        /// Spread the dynamic field's depths over its own box instead of the whole depth range.
        fit_dynamic_range: bool,
        /// Spread the static field's depths over its own box instead of the whole depth range.
        fit_static_range: bool,
        /// Count path lengths along the source-detector axis, not along the ray, as NeRF-CA does.
        #[serde(default)] along_axis: bool,
    }
}

section! {
    /// The optimiser.
    Adam, "adam" {
        /// Decay of the first moment.
        beta1: f64 in 0.0 to 0.999_999,
        /// Decay of the second moment.
        beta2: f64 in 0.0 to 0.999_999,
        /// Constant added to the denominator.
        epsilon: f64 in 1e-30 to 1.0,
        /// Share of the run over which learning rates change from start to end; then they stay constant.
        #[serde(default = "whole_run")] decay_share: f64 in 0.001 to 1.0,
    }
}
