//! Settings of X-Gaussian: the preset `x-gaussian`.

use crate::calibrate::settings::CalibrateMode;
use crate::config::choices::StaticData;
use crate::config::common::{Calibrate, Render, Train};
use crate::config::length::DRY_RUN_WITH_DENSIFYING;
use crate::config::method::{MethodSettings, Scaled};
use crate::config::section::{section, sections};
use crate::config::{Config, Preset, Shared};
use crate::error::{Error, Result};

/// Initial opacity of all Gaussians, as in the public code.
pub const FIRST_OPACITY: f64 = 0.1;

section! {
    /// Gaussians as X-Gaussian fits them with the defaults of its code for most of its scenes.
    X, "x" {
        /// Images that a set of Gaussians is fitted to: "per-phase" (those of its phase; a set per phase) or "pooled" (all; one
        /// set).
        static_data: StaticData,
        /// Upper limit that line integrals are clamped to (the lower limit is 0) before each image is scaled to 0 to 1; 0 = no
        /// clamping.
        clamp: f64 in 0.0 to 1e6,
        /// Half side of the volume, mm; 0 = 1.6 radii of the field of view, or the dataset's depth range where that is less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Voxels along each side of the volume.
        voxels: u32 in 1.0 to 2048.0,
        /// Distance between the initial centres of Gaussians along each axis, voxels.
        interval: u32 in 1.0 to 2048.0,
        /// Adam's rate of positions at the start, extents; it falls by a constant factor per iteration.
        #[serde(alias = "position_rate")] position_rate = "position_lr_init": f64 in 1e-12 to 100.0,
        /// Adam's rate of colours' first coefficients; those of higher degrees have a twentieth.
        #[serde(alias = "intensity_rate")] intensity_rate = "feature_lr": f64 in 1e-12 to 100.0,
        /// Adam's rate of opacities, before the sigmoid.
        #[serde(alias = "opacity_rate")] opacity_rate = "opacity_lr": f64 in 1e-12 to 100.0,
        /// Adam's rate of logarithms of scales.
        #[serde(alias = "scale_rate")] scale_rate = "scaling_lr": f64 in 1e-12 to 100.0,
        /// Adam's rate of quaternions.
        #[serde(alias = "rotation_rate")] rotation_rate = "rotation_lr": f64 in 1e-12 to 100.0,
        /// Weight of 1 - SSIM; the mean absolute difference has the rest of 1.
        #[serde(alias = "ssim")] ssim = "lambda_dssim": f64 in 0.0 to 0.99,
        /// Interval of density control, in iterations: Gaussians are added and pruned; 0 = never.
        #[serde(alias = "densify_every")] densify_every = "densification_interval": u32 in 0.0 to 1e6,
        /// Iteration after which density control begins.
        #[serde(alias = "densify_from")] densify_from = "densify_from_iter": u32 in 0.0 to 1e6,
        /// Iteration at which density control ends.
        #[serde(alias = "densify_until")] densify_until = "densify_until_iter": u32 in 0.0 to 1e6,
        /// Mean gradient of the loss with respect to a centre, in half images, at or above which a Gaussian is cloned or split.
        #[serde(alias = "densify_gradient")] densify_gradient = "densify_grad_threshold": f64 in 0.0 to 1e6,
        /// Threshold of the largest standard deviation, in extents, up to which a Gaussian is cloned, and above which it is
        /// split.
        #[serde(alias = "size_limit")] size_limit = "percent_dense": f64 in 0.0 to 10.0,
        /// Maximum number of Gaussians of a set.
        #[serde(alias = "most")] max_gaussians: u32 in 1.0 to 16_777_216.0,
        /// Opacity threshold below which a Gaussian is pruned.
        #[serde(alias = "weakest")] min_opacity: f64 in 0.0 to 1.0,
        /// Maximum standard deviation, in extents; larger Gaussians are pruned once opacities have been reset.
        #[serde(alias = "greatest_scale")] max_scale: f64 in 0.0 to 1e6,
        /// Interval, in iterations, at which opacities are reset while density control is active; 0 = never.
        #[serde(alias = "reset_every")] reset_every = "opacity_reset_interval": u32 in 0.0 to 1e6,
    } fixed {
        /// Extent of the scene, mm: the unit of position rates and scale bounds; 0 = 1.1 times the largest distance of a source
        /// from the mean of the sources.
        extent_mm: f64 in 0.0 to 1e6,
        /// Adam's rate of positions at the end.
        #[serde(alias = "position_rate_end")] position_rate_end = "position_lr_final": f64 in 1e-12 to 100.0,
        /// Interval, in iterations, after which colours gain a degree, up to three, which makes intensities change faster; 0 =
        /// never.
        degree_every: u32 in 0.0 to 1e6,
        /// Value that larger opacities are reset to.
        reset_opacity: f64 in 1e-6 to 0.99,
    }
}

sections! {
    /// Settings of static Gaussians of which nearer ones hide those behind them.
    XSettings {
        /// The Gaussians.
        x: X,
    }
}

/// X-Gaussian as its public code implements it: a static method, fitted to the normalised images of each phase. The numbers are those
/// of the public code for most of its scenes, for a run of 20,000 iterations.
pub(super) fn x_gaussian() -> Config<XSettings> {
    Config {
        preset: Preset::XGaussian,
        seed: 1,
        train: Train {
            iterations: 20_000,
            chunk_samples: 524_288,
            // Must divide the number of iterations between changes of the number of Gaussians.
            iterations_per_submit: 10,
            checkpoint_every: 5000,
            validate_every: 5000,
            stop_at_loss_ratio: 0.0,
        },
        calibrate: Calibrate { mode: CalibrateMode::Off },
        render: Render { render_samples: 2 },
        method: XSettings {
            x: X {
                static_data: StaticData::PerPhase,
                clamp: 1.0,
                half_extent_mm: 0.0,
                voxels: 256,
                interval: 8,
                extent_mm: 0.0,
                position_rate: 1.9e-4,
                position_rate_end: 1.9e-6,
                intensity_rate: 0.002,
                degree_every: 1000,
                opacity_rate: 0.008,
                scale_rate: 0.005,
                rotation_rate: 0.001,
                ssim: 0.2,
                densify_every: 200,
                densify_from: 500,
                densify_until: 8000,
                densify_gradient: 2.6e-5,
                size_limit: 0.01,
                max_gaussians: 500_000,
                min_opacity: 0.005,
                max_scale: 0.1,
                reset_every: 4000,
                reset_opacity: 0.01,
            },
        },
    }
}

impl MethodSettings for XSettings {
    fn name(&self) -> &'static str {
        "X-Gaussian"
    }

    fn check(&self, _: &Shared<'_>) -> Result<()> {
        let x = &self.x;
        if x.interval > x.voxels {
            return Err(Error::config("x.interval", x.interval, format!("exceeds x.voxels = {}", x.voxels)));
        }
        let count = u64::from(x.voxels.div_ceil(x.interval)).pow(3);
        if count > u64::from(x.max_gaussians) {
            let problem = format!(
                "is less than the {count} initial Gaussians that x.voxels = {} and x.interval = {} give",
                x.voxels, x.interval
            );
            return Err(Error::config("x.max_gaussians", x.max_gaussians, problem));
        }
        if x.min_opacity > FIRST_OPACITY {
            let problem = format!("exceeds the initial opacity, {FIRST_OPACITY}: all Gaussians would be pruned");
            return Err(Error::config("x.min_opacity", x.min_opacity, problem));
        }
        Ok(())
    }

    fn scale(&mut self, scaled: &Scaled) {
        let x = &mut self.x;
        scaled.apply_interval(&mut x.densify_every);
        for count in [&mut x.densify_from, &mut x.densify_until, &mut x.reset_every, &mut x.degree_every] {
            scaled.apply(count);
        }
    }

    fn events(&self) -> Vec<u32> {
        let x = &self.x;
        vec![x.degree_every, x.densify_from, x.reset_every, x.densify_until]
    }

    fn is_blended(&self) -> bool {
        true
    }

    fn dry_run_length(&self) -> u32 {
        DRY_RUN_WITH_DENSIFYING
    }

    fn gaussian_iterations(&self, train: &Train) -> u32 {
        train.iterations
    }

    fn gaussian_iterations_mut<'a>(&'a mut self, train: &'a mut Train) -> Option<&'a mut u32> {
        Some(&mut train.iterations)
    }
}
