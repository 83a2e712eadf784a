//! Settings of R2-Gaussian: the preset `r2-gaussian`.

use crate::calibrate::settings::CalibrateMode;
use crate::config::choices::{R2Integral, R2Start, StaticData};
use crate::config::common::{Calibrate, Render, Train};
use crate::config::length::DRY_RUN_WITH_DENSIFYING;
use crate::config::method::{MethodSettings, Scaled};
use crate::config::section::{section, sections};
use crate::config::{Config, Preset, Shared};
use crate::error::{Error, Result};

section! {
    /// Gaussians as R2-Gaussian fits them with the defaults of its code. The volume is a cube around
    /// the isocentre. Lengths are shares of the cube's side; rates are shares of half the side.
    R2, "r2" {
        /// Images that a set of Gaussians is fitted to: "per-phase" (those of its phase; a set per phase) or "pooled" (all; one
        /// set).
        static_data: StaticData,
        /// Line integral of a Gaussian at a pixel: "affine" (as published: under a projection linearised around the Gaussian's
        /// centre) or "exact" (along the pixel's own ray).
        #[serde(default)] integral: R2Integral,
        /// Half side of the volume, mm; 0 = 1.6 radii of the field of view, or the dataset's depth range where that is
        /// less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Voxels along each side of the volume, for the back-projection and the box of total variation.
        voxels: u32 in 8.0 to 512.0,
        /// Gaussians of a set at the start.
        #[serde(alias = "count")] count = "n_points": u32 in 1.0 to 1_048_576.0,
        /// Maximum standard deviation.
        #[serde(alias = "greatest_scale")] max_scale = "scale_max": f64 in 1e-6 to 10.0,
        /// Adam's rate of positions at the start; rates fall by a constant factor per iteration.
        #[serde(alias = "position_rate")] position_rate = "position_lr_init": f64 in 1e-12 to 100.0,
        /// Adam's rate of densities, before the softplus, at the start.
        #[serde(alias = "density_rate")] density_rate = "density_lr_init": f64 in 1e-12 to 100.0,
        /// Adam's rate of scales, before the sigmoid, at the start.
        #[serde(alias = "scale_rate")] scale_rate = "scaling_lr_init": f64 in 1e-12 to 100.0,
        /// Adam's rate of quaternions at the start.
        #[serde(alias = "rotation_rate")] rotation_rate = "rotation_lr_init": f64 in 1e-12 to 100.0,
        /// Weight of 1 - SSIM; the mean absolute difference has weight 1.
        #[serde(alias = "ssim")] ssim = "lambda_dssim": f64 in 0.0 to 1e3,
        /// Weight of total variation in a box of voxels.
        #[serde(alias = "tv")] tv = "lambda_tv": f64 in 0.0 to 1e3,
        /// Voxels along each side of that box, which is placed anew in each iteration.
        #[serde(alias = "tv_box")] tv_box = "tv_vol_size": u32 in 2.0 to 128.0,
        /// Interval of density control, in iterations: Gaussians are added and pruned; 0 = never.
        #[serde(alias = "densify_every")] densify_every = "densification_interval": u32 in 0.0 to 1e6,
        /// Iteration after which density control begins.
        #[serde(alias = "densify_from")] densify_from = "densify_from_iter": u32 in 0.0 to 1e6,
        /// Iteration at which density control ends.
        #[serde(alias = "densify_until")] densify_until = "densify_until_iter": u32 in 0.0 to 1e6,
        /// Mean gradient of the loss with respect to a centre, in half images, at or above which a Gaussian is cloned or split.
        #[serde(alias = "densify_gradient")] densify_gradient = "densify_grad_threshold": f64 in 0.0 to 1e6,
        /// Threshold of the largest standard deviation up to which a Gaussian is cloned, and above which it is split.
        #[serde(alias = "size_limit")] size_limit = "densify_scale_threshold": f64 in 0.0 to 10.0,
        /// Maximum number of Gaussians of a set.
        #[serde(alias = "most")] max_num_gaussians: u32 in 1.0 to 1_048_576.0,
        /// Density threshold below which a Gaussian is pruned.
        #[serde(alias = "weakest")] density_min_threshold: f64 in 0.0 to 1e3,
    } fixed {
        /// Initial positions: "fdk" (voxels of a filtered back-projection) or "random".
        init: R2Start,
        /// Divide line integrals by the vessels' attenuation where the dataset states it, so that densities are near 1.
        normalise: bool,
        /// Threshold of the back-projection above which a Gaussian may be seeded at a voxel.
        #[serde(alias = "candidate")] candidate = "density_thresh": f64 in 0.0 to 1e3,
        /// Minimum standard deviation.
        #[serde(alias = "least_scale")] min_scale = "scale_min": f64 in 1e-6 to 1.0,
        /// Let total variation move Gaussians. The public code computes this gradient, but mistakenly scales it by the square
        /// of a voxel's side, so that it has no effect.
        tv_moves_centres: bool,
    }
}

sections! {
    /// Settings of static Gaussians with line integrals.
    R2Settings {
        /// The Gaussians.
        r2: R2,
    }
}

/// R2-Gaussian as its public code implements it: a static method, fitted to the whole images of each phase. The numbers are those of
/// the public code, for a run of 30,000 iterations.
pub(super) fn r2_gaussian() -> Config<R2Settings> {
    Config {
        preset: Preset::R2Gaussian,
        seed: 1,
        train: Train {
            iterations: 30_000,
            chunk_samples: 524_288,
            // Must divide the number of iterations between changes of the number of Gaussians.
            iterations_per_submit: 10,
            checkpoint_every: 5000,
            validate_every: 5000,
            stop_at_loss_ratio: 0.0,
        },
        calibrate: Calibrate { mode: CalibrateMode::Off },
        render: Render { render_samples: 2 },
        method: R2Settings {
            r2: R2 {
                static_data: StaticData::PerPhase,
                init: R2Start::Fdk,
                integral: R2Integral::Affine,
                normalise: true,
                half_extent_mm: 0.0,
                voxels: 256,
                count: 50_000,
                candidate: 0.05,
                min_scale: 0.0005,
                max_scale: 0.5,
                position_rate: 2e-4,
                density_rate: 1e-2,
                scale_rate: 5e-3,
                rotation_rate: 1e-3,
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
            },
        },
    }
}

impl MethodSettings for R2Settings {
    fn name(&self) -> &'static str {
        "R2-Gaussian"
    }

    fn check(&self, _: &Shared<'_>) -> Result<()> {
        let r2 = &self.r2;
        if r2.tv_box > r2.voxels {
            return Err(Error::config("r2.tv_vol_size", r2.tv_box, format!("exceeds r2.voxels = {}", r2.voxels)));
        }
        if r2.min_scale >= r2.max_scale {
            let problem = format!("is not above the minimum, {}", r2.min_scale);
            return Err(Error::config("r2.scale_max", r2.max_scale, problem));
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

    fn scale(&mut self, scaled: &Scaled) {
        scaled.apply_interval(&mut self.r2.densify_every);
        scaled.apply(&mut self.r2.densify_from);
        scaled.apply(&mut self.r2.densify_until);
    }

    fn events(&self) -> Vec<u32> {
        vec![self.r2.densify_from, self.r2.densify_until]
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
