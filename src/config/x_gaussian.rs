//! Settings of X-Gaussian: the preset `x-gaussian`.

use crate::config::checks::check_alone;
use crate::config::length::DRY_RUN_WITH_DENSIFYING;
use crate::config::method::{MethodSettings, Scaled};
use crate::config::section::section;
use crate::config::sections::{Gaussians, Train};
use crate::config::{Config, GaussianForm, Preset, StaticData, r2_gaussian};
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

section! {
    /// Gaussians as X-Gaussian fits them (`gaussians.form = "x"`), with the defaults of its code for most of its scenes.
    X, "x" {
        /// Images that a set of Gaussians is fitted to: "per-phase" (those of its phase; a set per phase) or "pooled" (all; one
        /// set).
        static_data: StaticData,
        /// Divide line integrals by the vessels' attenuation where the dataset states it, before they are clamped.
        normalise: bool,
        /// Upper limit that line integrals are clamped to (the lower limit is 0) before each image is scaled to 0 to 1; 0 = no
        /// clamping.
        clamp: f64 in 0.0 to 1e6,
        /// Half side of the volume, mm; 0 = 1.6 radii of the field of view, or the dataset's depth range where that is less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Voxels along each side of the volume.
        voxels: u32 in 1.0 to 2048.0,
        /// Distance between the initial centres of Gaussians along each axis, voxels.
        interval: u32 in 1.0 to 2048.0,
        /// Extent of the scene, mm: the unit of position rates and scale bounds; 0 = 1.1 times the largest distance of a source
        /// from the mean of the sources.
        extent_mm: f64 in 0.0 to 1e6,
        /// Initial opacity.
        first_opacity: f64 in 1e-6 to 0.99,
        /// Adam's rate of positions at the start, extents; it falls by a constant factor per iteration.
        #[serde(rename = "position_lr_init", alias = "position_rate")]
        position_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of positions at the end.
        #[serde(rename = "position_lr_final", alias = "position_rate_end")]
        position_rate_end: f64 in 1e-12 to 100.0,
        /// Adam's rate of colours' first coefficients; those of higher degrees have a twentieth.
        #[serde(rename = "feature_lr", alias = "intensity_rate")]
        intensity_rate: f64 in 1e-12 to 100.0,
        /// Interval, in iterations, after which colours gain a degree, up to three, which makes intensities change faster; 0 =
        /// never.
        degree_every: u32 in 0.0 to 1e6,
        /// Adam's rate of opacities, before the sigmoid.
        #[serde(rename = "opacity_lr", alias = "opacity_rate")]
        opacity_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of logarithms of scales.
        #[serde(rename = "scaling_lr", alias = "scale_rate")]
        scale_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of quaternions.
        #[serde(rename = "rotation_lr", alias = "rotation_rate")]
        rotation_rate: f64 in 1e-12 to 100.0,
        /// Weight of 1 - SSIM; the mean absolute difference has the rest of 1.
        #[serde(rename = "lambda_dssim", alias = "ssim")]
        ssim: f64 in 0.0 to 0.99,
        /// Interval of density control, in iterations: Gaussians are added and pruned; 0 = never.
        #[serde(rename = "densification_interval", alias = "densify_every")]
        densify_every: u32 in 0.0 to 1e6,
        /// Iteration after which density control begins.
        #[serde(rename = "densify_from_iter", alias = "densify_from")]
        densify_from: u32 in 0.0 to 1e6,
        /// Iteration at which density control ends.
        #[serde(rename = "densify_until_iter", alias = "densify_until")]
        densify_until: u32 in 0.0 to 1e6,
        /// Mean gradient of the loss with respect to a centre, in half images, at or above which a Gaussian is cloned or split.
        #[serde(rename = "densify_grad_threshold", alias = "densify_gradient")]
        densify_gradient: f64 in 0.0 to 1e6,
        /// Threshold of the largest standard deviation, in extents, up to which a Gaussian is cloned, and above which it is
        /// split.
        #[serde(rename = "percent_dense", alias = "size_limit")]
        size_limit: f64 in 0.0 to 10.0,
        /// Maximum number of Gaussians of a set.
        #[serde(alias = "most")]
        max_gaussians: u32 in 1.0 to 16_777_216.0,
        /// Opacity threshold below which a Gaussian is pruned.
        #[serde(alias = "weakest")]
        min_opacity: f64 in 0.0 to 1.0,
        /// Maximum standard deviation, in extents; larger Gaussians are pruned once opacities have been reset.
        #[serde(alias = "greatest_scale")]
        max_scale: f64 in 0.0 to 1e6,
        /// Maximum radius in an image, pixels; larger Gaussians are pruned once opacities have been reset; 0 = no limit. The
        /// public code sets 20, but clears the radii before it reads them.
        #[serde(rename = "max_screen_size", alias = "greatest_radius")]
        max_radius: f64 in 0.0 to 1e6,
        /// Interval, in iterations, at which opacities are reset while density control is active; 0 = never.
        #[serde(rename = "opacity_reset_interval", alias = "reset_every")]
        reset_every: u32 in 0.0 to 1e6,
        /// Value that larger opacities are reset to.
        reset_opacity: f64 in 1e-6 to 0.99,
    }
}

/// The constants of X-Gaussian's public code for most of its scenes, for a run of 20,000 iterations.
pub(super) fn x() -> X {
    X {
        static_data: StaticData::PerPhase,
        normalise: true,
        clamp: 1.0,
        half_extent_mm: 0.0,
        voxels: 256,
        interval: 8,
        extent_mm: 0.0,
        first_opacity: 0.1,
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
        max_radius: 0.0,
        reset_every: 4000,
        reset_opacity: 0.01,
    }
}

/// X-Gaussian as its public code implements it: a static method, fitted to the normalised images of each phase.
pub(super) fn x_gaussian() -> Config {
    let r2 = r2_gaussian::r2_gaussian();
    Config {
        preset: Preset::XGaussian,
        train: Train { iterations: 20_000, ..r2.train },
        gaussians: Gaussians { form: GaussianForm::X, ..r2.gaussians },
        ..r2
    }
}

/// Constants of X-Gaussian's public code, and our choice of units.
const CONSTANTS: [&str; 7] = [
    "normalise",
    "extent_mm",
    "first_opacity",
    "position_lr_final",
    "degree_every",
    "max_screen_size",
    "reset_opacity",
];

/// Settings of the method, for [`MethodKind::settings`](crate::config::method::MethodKind::settings).
pub(super) struct Settings;

impl MethodSettings for Settings {
    fn check(&self, config: &Config) -> Result<()> {
        check_alone(config)?;
        let x = &config.x;
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
        if x.first_opacity < x.min_opacity {
            let problem = format!("is below x.min_opacity = {}: all Gaussians would be pruned", x.min_opacity);
            return Err(Error::config("x.first_opacity", x.first_opacity, problem));
        }
        Ok(())
    }

    fn is_key(&self, _: Preset, key: &str) -> bool {
        key.strip_prefix("x.").is_some_and(|name| !CONSTANTS.contains(&name))
    }

    fn schedule(&self, config: &Config, scaled: &Scaled) -> Vec<(&'static str, u32)> {
        vec![
            ("x.densification_interval", scaled.interval(config.x.densify_every)),
            ("x.densify_from_iter", scaled.count(config.x.densify_from)),
            ("x.densify_until_iter", scaled.count(config.x.densify_until)),
            ("x.opacity_reset_interval", scaled.count(config.x.reset_every)),
            ("x.degree_every", scaled.count(config.x.degree_every)),
        ]
    }

    fn events(&self, config: &Config) -> Vec<u32> {
        let x = &config.x;
        vec![x.degree_every, x.densify_from, x.reset_every, x.densify_until]
    }

    fn dry_run_length(&self) -> u32 {
        DRY_RUN_WITH_DENSIFYING
    }
}
