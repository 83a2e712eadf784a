//! Settings of R2-Gaussian: the preset `r2-gaussian`.

use crate::config::checks::check_alone;
use crate::config::length::DRY_RUN_WITH_DENSIFYING;
use crate::config::method::{MethodSettings, Scaled};
use crate::config::section::section;
use crate::config::sections::{Adam, DynamicField, Gaussians, March, StaticField, Train};
use crate::config::{Config, GaussianForm, Preset, R2Integral, R2Start, StaticData, StaticForm, nert_ca};
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

section! {
    /// Gaussians as R2-Gaussian fits them (`gaussians.form = "r2"`), with the defaults of its code. The volume is a cube around
    /// the isocentre. Lengths are shares of the cube's side; rates are shares of half the side.
    R2, "r2" {
        /// Images that a set of Gaussians is fitted to: "per-phase" (those of its phase; a set per phase) or "pooled" (all; one
        /// set).
        static_data: StaticData,
        /// Initial positions: "fdk" (voxels of a filtered back-projection) or "random".
        init: R2Start,
        /// Line integral of a Gaussian at a pixel: "affine" (as published: under a projection linearised around the Gaussian's
        /// centre) or "exact" (along the pixel's own ray).
        #[serde(default)] integral: R2Integral,
        /// Divide line integrals by the vessels' attenuation where the dataset states it, so that densities are near 1.
        normalise: bool,
        /// Half side of the volume, mm; 0 = 1.6 radii of the field of view, or the dataset's depth range where that is
        /// less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Voxels along each side of the volume, for the back-projection and the box of total variation.
        voxels: u32 in 8.0 to 512.0,
        /// Gaussians of a set at the start.
        #[serde(rename = "n_points", alias = "count")]
        count: u32 in 1.0 to 1_048_576.0,
        /// Density of a Gaussian at the start, as a share of the back-projection there.
        #[serde(rename = "density_rescale", alias = "density_share")]
        density_share: f64 in 1e-6 to 1e3,
        /// Threshold of the back-projection above which a Gaussian may be seeded at a voxel.
        #[serde(rename = "density_thresh", alias = "candidate")]
        candidate: f64 in 0.0 to 1e3,
        /// Minimum standard deviation.
        #[serde(rename = "scale_min", alias = "least_scale")]
        min_scale: f64 in 1e-6 to 1.0,
        /// Maximum standard deviation.
        #[serde(rename = "scale_max", alias = "greatest_scale")]
        max_scale: f64 in 1e-6 to 10.0,
        /// Adam's rate of positions at the start; rates fall by a constant factor per iteration.
        #[serde(rename = "position_lr_init", alias = "position_rate")]
        position_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of positions at the end.
        #[serde(rename = "position_lr_final", alias = "position_rate_end")]
        position_rate_end: f64 in 1e-12 to 100.0,
        /// Adam's rate of densities, before the softplus, at the start.
        #[serde(rename = "density_lr_init", alias = "density_rate")]
        density_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of densities at the end.
        #[serde(rename = "density_lr_final", alias = "density_rate_end")]
        density_rate_end: f64 in 1e-12 to 100.0,
        /// Adam's rate of scales, before the sigmoid, at the start.
        #[serde(rename = "scaling_lr_init", alias = "scale_rate")]
        scale_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of scales at the end.
        #[serde(rename = "scaling_lr_final", alias = "scale_rate_end")]
        scale_rate_end: f64 in 1e-12 to 100.0,
        /// Adam's rate of quaternions at the start.
        #[serde(rename = "rotation_lr_init", alias = "rotation_rate")]
        rotation_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of quaternions at the end.
        #[serde(rename = "rotation_lr_final", alias = "rotation_rate_end")]
        rotation_rate_end: f64 in 1e-12 to 100.0,
        /// Weight of 1 - SSIM; the mean absolute difference has weight 1.
        #[serde(rename = "lambda_dssim", alias = "ssim")]
        ssim: f64 in 0.0 to 1e3,
        /// Weight of total variation in a box of voxels.
        #[serde(rename = "lambda_tv", alias = "tv")]
        tv: f64 in 0.0 to 1e3,
        /// Voxels along each side of that box, which is placed anew in each iteration.
        #[serde(rename = "tv_vol_size", alias = "tv_box")]
        tv_box: u32 in 2.0 to 128.0,
        /// Let total variation move Gaussians. The public code computes this gradient, but mistakenly scales it by the square
        /// of a voxel's side, so that it has no effect.
        tv_moves_centres: bool,
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
        /// Threshold of the largest standard deviation up to which a Gaussian is cloned, and above which it is split.
        #[serde(rename = "densify_scale_threshold", alias = "size_limit")]
        size_limit: f64 in 0.0 to 10.0,
        /// Maximum number of Gaussians of a set.
        #[serde(alias = "most")]
        max_num_gaussians: u32 in 1.0 to 1_048_576.0,
        /// Density threshold below which a Gaussian is pruned.
        #[serde(alias = "weakest")]
        density_min_threshold: f64 in 0.0 to 1e3,
    }
}

/// The constants of R2-Gaussian's public code, for a run of 30,000 iterations.
pub(super) fn r2() -> R2 {
    R2 {
        static_data: StaticData::PerPhase,
        init: R2Start::Fdk,
        integral: R2Integral::Affine,
        normalise: true,
        half_extent_mm: 0.0,
        voxels: 256,
        count: 50_000,
        density_share: 0.15,
        candidate: 0.05,
        min_scale: 0.0005,
        max_scale: 0.5,
        position_rate: 2e-4,
        position_rate_end: 2e-5,
        density_rate: 1e-2,
        density_rate_end: 1e-3,
        scale_rate: 5e-3,
        scale_rate_end: 5e-4,
        rotation_rate: 1e-3,
        rotation_rate_end: 1e-4,
        ssim: 0.25,
        tv: 0.05,
        tv_box: 32,
        tv_moves_centres: false,
        densify_every: 100,
        densify_from: 500,
        densify_until: 15_000,
        densify_gradient: 5e-5,
        size_limit: 0.1,
        max_num_gaussians: 500_000,
        density_min_threshold: 1e-5,
    }
}

/// R2-Gaussian as its public code implements it: a static method, fitted to the whole images of each phase.
pub(super) fn r2_gaussian() -> Config {
    let paper = nert_ca::paper();
    Config {
        preset: Preset::R2Gaussian,
        train: Train {
            iterations: 30_000,
            // Must divide the number of iterations between changes of the number of Gaussians.
            iterations_per_submit: 10,
            checkpoint_every: 5000,
            validate_every: 5000,
            ..paper.train
        },
        // Rays are marched through neither field, and there is no static field.
        march: March { static_samples: 2, dynamic_samples: 2, render_samples: 2, ..paper.march },
        static_field: StaticField { form: StaticForm::None, ..paper.static_field },
        // There is no network; its settings are recorded only.
        dynamic: DynamicField { layers: 1, width: 16, latent: 4, bands: 1, delay: 0, ..paper.dynamic },
        adam: Adam { beta2: 0.999, epsilon: 1e-15, ..paper.adam },
        gaussians: Gaussians { form: GaussianForm::R2, ..paper.gaussians },
        ..paper
    }
}

/// Constants of R2-Gaussian's public code, and our choice of units and of what the total variation moves.
const CONSTANTS: [&str; 6] =
    ["init", "normalise", "density_rescale", "density_thresh", "scale_min", "tv_moves_centres"];

/// Settings of the method, for [`MethodKind::settings`](crate::config::method::MethodKind::settings).
pub(super) struct Settings;

impl MethodSettings for Settings {
    fn check(&self, config: &Config) -> Result<()> {
        check_alone(config)?;
        let r2 = &config.r2;
        if r2.tv_box > r2.voxels {
            return Err(Error::config("r2.tv_vol_size", r2.tv_box, format!("exceeds r2.voxels = {}", r2.voxels)));
        }
        if r2.min_scale >= r2.max_scale {
            let problem = format!("is not below r2.scale_max = {}", r2.max_scale);
            return Err(Error::config("r2.scale_min", r2.min_scale, problem));
        }
        if r2.count > r2.max_num_gaussians {
            return Err(Error::config(
                "r2.n_points",
                r2.count,
                format!("exceeds r2.max_num_gaussians = {}", r2.max_num_gaussians),
            ));
        }
        Ok(())
    }

    fn is_key(&self, _: Preset, key: &str) -> bool {
        key.strip_prefix("r2.").is_some_and(|name| !CONSTANTS.contains(&name) && !name.ends_with("_lr_final"))
    }

    fn schedule(&self, config: &Config, scaled: &Scaled) -> Vec<(&'static str, u32)> {
        vec![
            ("r2.densification_interval", scaled.interval(config.r2.densify_every)),
            ("r2.densify_from_iter", scaled.count(config.r2.densify_from)),
            ("r2.densify_until_iter", scaled.count(config.r2.densify_until)),
        ]
    }

    fn events(&self, config: &Config) -> Vec<u32> {
        vec![config.r2.densify_from, config.r2.densify_until]
    }

    fn dry_run_length(&self) -> u32 {
        DRY_RUN_WITH_DENSIFYING
    }
}
