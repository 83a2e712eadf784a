//! The sections of a configuration: each hyper-parameter with its meaning and accepted range.

use crate::config::forms::{
    CalibrateMode, Decay, DynamicForm, DynamicTarget, GaussianForm, OcclusionRegion, R2Integral, R2Start, StaticData,
    StaticForm,
};
use crate::config::renamed;
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// Declares a section; `in LOW to HIGH` after a number's type is the range that [`Config::check`](super::Config::check)
/// accepts.
macro_rules! section {
    ($(#[$about:meta])* $name:ident, $prefix:literal {
        $($(#[$doc:meta])* $field:ident: $ty:ident $(in $low:literal to $high:literal)?,)*
    }) => {
        $(#[$about])*
        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $($(#[$doc])* pub $field: $ty,)*
        }

        impl $name {
            pub(super) fn check_ranges(&self) -> Result<()> {
                $($(check_range(concat!($prefix, ".", stringify!($field)), f64::from(self.$field), $low, $high)?;)?)*
                Ok(())
            }
        }
    };
}

pub(super) fn check_range(field: &str, value: f64, low: f64, high: f64) -> Result<()> {
    // A value that is not a number (NaN) is in no range.
    if value >= low && value <= high {
        return Ok(());
    }
    Err(Error::config(renamed::current(field), value, format!("is not in the accepted range, {low} to {high}")))
}

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
    /// The static field. As a network ("network") it has the layers of the dynamic field; only the learning rate settings below
    /// apply then.
    StaticField, "static" {
        /// Representation: "tensor" (low-rank planes and lines), "network", or "none", which only R2-Gaussian, X-Gaussian and
        /// SAX-NeRF accept.
        #[serde(default)] form: StaticForm,
        /// Cells per axis, D.
        grid: u32 in 2.0 to 512.0,
        /// Ranks per mode, R.
        ranks: u32 in 1.0 to 64.0,
        /// Half side of its box, mm; 0 = 1.6 radii of the field of view, or the dataset's depth range where that is less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Standard deviation of the initial planes and lines.
        init_std: f64 in 0.0 to 10.0,
        /// Learning rate at the start.
        lr: f64 in 0.0 to 100.0,
        /// Learning rate at the end.
        lr_end: f64 in 0.0 to 100.0,
        /// Course of the learning rate.
        decay: Decay,
        /// Weight of total variation, lambda_TV.
        tv: f64 in 0.0 to 1e6,
        /// Share of the planes in the total variation.
        tv_plane: f64,
        /// Share of the lines in the total variation.
        tv_line: f64,
    }
}

section! {
    /// The dynamic neural field.
    DynamicField, "dynamic" {
        /// Representation where the dynamic field does not consist of Gaussians: "network", or "lineformer" (configured in
        /// section `sax`; no other setting of this section applies then).
        #[serde(default)] form: DynamicForm,
        /// Hidden layers.
        layers: u32 in 1.0 to 16.0,
        /// Neurons per hidden layer, a multiple of 16.
        width: u32 in 16.0 to 1024.0,
        /// Hidden layer (from 1) that sees the encoded input again; 0 = none.
        skip_layer: u32,
        /// Length of a phase's latent vector.
        latent: u32 in 1.0 to 64.0,
        /// Frequency bands of the encoding.
        bands: u32 in 1.0 to 16.0,
        /// Bands open when the field starts.
        window_start: f64,
        /// Iterations until all bands are open, counted from the delay.
        window_iterations: u32,
        /// Half side of its box, mm; 0 = the field of view.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Encode coordinates relative to the field's box instead of world units.
        encode_box: bool,
        /// Iterations before the field starts. After the first iteration with it, moments and learning rates of both fields
        /// start again.
        delay: u32,
        /// Learning rate at the start.
        lr: f64 in 0.0 to 100.0,
        /// Learning rate at the end.
        lr_end: f64 in 0.0 to 100.0,
        /// Course of the learning rate.
        decay: Decay,
        /// Shift inside its softplus when the problem is normalised.
        normalised_shift: f64 in -20.0 to 20.0,
        /// With a temporal target, start at the best constant field instead.
        best_start: bool,
        /// Minimum slope of its softplus where a ray demands more attenuation, so that the gradient cannot vanish; 0 = none.
        least_slope: f64 in 0.0 to 1.0,
        /// Weight of occlusion minimisation, lambda_o.
        occlusion: f64 in 0.0 to 1e6,
        /// Share of the depth range, counted from the source, that occlusion minimisation covers; with two networks, that
        /// `networks.near_integral` covers.
        occlusion_share: f64 in 0.0 to 1.0,
        /// Region of occlusion minimisation: "depth-range" (that share of the depth range) or "last-ray" (that
        /// share of the path length of the batch's last ray).
        #[serde(default)] occlusion_region: OcclusionRegion,
    }
}

section! {
    /// Loss terms.
    Loss, "loss" {
        /// Scale both fields and residuals by the data, so that numbers are near 1.
        normalise: bool,
        /// Data that the dynamic field is fitted to.
        dynamic_target: DynamicTarget,
        /// Residual of the dynamic field, as a share of strong temporal change, from which its loss grows linearly with a
        /// temporal target, when the problem is normalised; 0 = squared throughout.
        robust: f64 in 0.0 to 1e3,
    }
}

section! {
    /// Motion hull: where every view shows temporal change.
    Hull, "hull" {
        /// Restrict the dynamic field to it.
        enabled: bool,
        /// Carve each phase from its own images too, not only from the pixels that move over the whole beat.
        per_phase: bool,
        /// Cells along each side.
        resolution: u32 in 8.0 to 512.0,
        /// A pixel moves when its temporal range exceeds what noise gives by this many standard deviations.
        noise_sigmas: f64 in 0.0 to 1e3,
        /// A pixel moves, with four views or more, when its range also exceeds this share of the strongest change in its view.
        min_share: f64 in 0.0 to 1.0,
        /// Threshold like `min_share` for fewer than four views: they carve less, so the threshold has to be higher.
        min_share_few_views: f64 in 0.0 to 1.0,
        /// Half width of the widest vessel, pixels: structures up to this width may be hidden in the static background. 0 takes
        /// each pixel's minimum over the phases as its background.
        vessel_pixels: u32 in 0.0 to 1024.0,
        /// Pixels by which moving regions grow.
        dilate_pixels: u32 in 0.0 to 64.0,
        /// Larger hulls (share of the box) are not used.
        max_share: f64 in 0.0 to 1.0,
    }
}

section! {
    /// Occupancy grid learned during training: where the dynamic field is empty, most samples are left out.
    Occupancy, "occupancy" {
        /// Leave out samples where the field is empty.
        enabled: bool,
        /// Cells along each side of the dynamic field's box, for each phase.
        cells: u32 in 2.0 to 256.0,
        /// Iterations of the dynamic field before samples are left out.
        start: u32 in 0.0 to 1e6,
        /// Attenuation up to which a sample is empty, as a share of the dynamic field's scale: a typical vessel's when the
        /// problem is normalised, 0.01 per mm otherwise.
        threshold: f64 in 0.0 to 1.0,
    }
}

section! {
    /// Two networks as the fields (`static.form = "network"`), as in NeRF-CA. Loss weights change linearly from their first
    /// value to their last one and then stay constant.
    Networks, "networks" {
        /// Attenuation of either field where its softplus is 1, per world unit.
        gain: f64 in 1e-9 to 1e6,
        /// Extra weight of rays whose pixel changes: a ray weighs 1 + this times the change of its X-ray transmission over the
        /// beat, from 0 to 1 in each view.
        change_weight: f64 in 0.0 to 1e3,
        /// Change, as a share of the view's maximum, above which `train.motion_share` counts a ray as moving.
        least_change: f64 in 0.0 to 1.0,
        /// Minimum line integral of the dynamic field at which its entropy along a ray counts although the ray does not change.
        least_integral: f64 in 0.0 to 1e6,
        /// Iterations before the losses `favour_static` and `near_integral` count.
        delay: u32 in 0.0 to 1e6,
        /// Iterations over which weights change from the first value to the last.
        ramp: u32 in 1.0 to 1e6,
        /// First weight of the entropy of the fields' shares at samples; it makes each sample belong to one field.
        favour_static: f64 in 0.0 to 1e6,
        /// Last weight of this loss.
        favour_static_end: f64 in 0.0 to 1e6,
        /// First weight of the entropy of the dynamic field along rays.
        ray_entropy: f64 in 0.0 to 1e6,
        /// Last weight of this loss.
        ray_entropy_end: f64 in 0.0 to 1e6,
        /// First weight of the dynamic field's integral over the share `dynamic.occlusion_share` of the ray nearest to the
        /// source.
        near_integral: f64 in 0.0 to 1e6,
        /// Last weight of this loss.
        near_integral_end: f64 in 0.0 to 1e6,
        /// First weight of the static field's integrals over intervals and of their squares.
        static_size: f64 in 0.0 to 1e6,
        /// Last weight of this loss.
        static_size_end: f64 in 0.0 to 1e6,
        /// Iterations after which learning ends when an entropy has vanished; 0 = never.
        stop_after: u32 in 0.0 to 1e6,
        /// Threshold of an unweighted entropy below which it counts as vanished.
        stop_below: f64 in 0.0 to 1.0,
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

section! {
    /// Gaussians as the dynamic field. Lengths are in pixels at the isocentre for images whose smaller side has 100 pixels, and
    /// scale with the image size; line integrals are shares of the views' strongest change.
    Gaussians, "gaussians" {
        /// Representation of the dynamic field: "none" (the network), "phase", "deformable", "auto", or "r2" and "x" (configured in
        /// the sections `r2` and `x`; no other setting of this section applies then).
        form: GaussianForm,
        /// Iterations, each over all images.
        iterations: u32 in 1.0 to 1e6,
        /// Gaussians seeded per phase.
        count: u32 in 1.0 to 1_048_576.0,
        /// Initial scale.
        first_scale: f64 in 0.01 to 100.0,
        /// Minimum scale; noise raises it by up to half where vessels are wide enough.
        least_scale: f64 in 0.01 to 100.0,
        /// Maximum scale.
        greatest_scale: f64 in 0.01 to 100.0,
        /// Adam's rate of positions.
        position_rate: f64 in 0.0 to 100.0,
        /// Adam's rate of log-scales.
        scale_rate: f64 in 0.0 to 100.0,
        /// Adam's rate of quaternions.
        rotation_rate: f64 in 0.0 to 100.0,
        /// Adam's rate of log-densities.
        density_rate: f64 in 0.0 to 100.0,
        /// Share of the iterations, at the end, over which rates fall.
        fall_share: f64 in 0.001 to 1.0,
        /// Final learning rates, as a share of their initial values.
        last_rate: f64 in 0.0 to 1.0,
        /// Residual at which the loss changes from quadratic to linear.
        bend: f64 in 1e-6 to 1e3,
        /// Noise at which the weight of a pixel is 0.7; 0 = all pixels have the same weight.
        noise_scale: f64 in 0.0 to 1e3,
        /// Number of standard deviations at which a Gaussian is cut off.
        cut: f64 in 1.0 to 10.0,
        /// Iteration at which weak Gaussians are pruned and new ones are seeded where line integrals are missing; 0 = never.
        grow_at: u32 in 0.0 to 1e6,
        /// New Gaussians per phase, as a share of `count`.
        grow_share: f64 in 0.0 to 10.0,
        /// Amplitude threshold below which a Gaussian is pruned.
        weakest: f64 in 0.0 to 1e3,
        /// Iteration at which Gaussians too faint for vessels are pruned, since they represent other moving structures; 0 =
        /// never.
        clear_at: u32 in 0.0 to 1e6,
        /// Density below which a Gaussian is too faint, as a share of the vessels' density.
        faint: f64 in 0.0 to 1.0,
        /// Distance within which Gaussians belong to one vessel, in the unit of the scales. Broad isolated Gaussians are pruned
        /// after all iterations; 0 = never, the default for older files without this setting.
        #[serde(default)] link: f64 in 0.0 to 1e3,
        /// Minimum missing line integral at which a Gaussian is seeded; also its initial density.
        missing: f64 in 1e-6 to 1e3,
        /// Interval, in iterations, at which the static background is estimated again from the images minus the Gaussians; not
        /// while rates fall; 0 = never.
        background_every: u32 in 0.0 to 1e6,
    }
}

section! {
    /// One set of Gaussians that moves over the beat. Lengths are in the unit of section `gaussians`.
    Deformable, "tree" {
        /// Iterations that fit a set per phase, before the deformable set is made from one of these sets.
        warm_iterations: u32 in 1.0 to 1e6,
        /// Minimum amplitude at which a Gaussian of the rest phase is taken into the deformable set, as a share of the views' strongest
        /// change.
        take: f64 in 0.0 to 1e3,
        /// Distance between nodes of the displacement grid.
        node: f64 in 1.0 to 1e4,
        /// Adam's rate of displacements.
        grid_rate: f64 in 0.0 to 100.0,
        /// Penalty on squared differences of neighbouring nodes.
        smoothness: f64 in 0.0 to 1e6,
        /// Harmonics of a Gaussian's own motion.
        harmonics: u32 in 0.0 to 64.0,
        /// Adam's rate of the Gaussians' own motion.
        own_rate: f64 in 0.0 to 100.0,
        /// Penalty on squared own motion.
        own_penalty: f64 in 0.0 to 1e6,
        /// Blur of images and Gaussians while the grid is tracked.
        track_blur: f64 in 0.1 to 100.0,
        /// Adam's rate of displacements while they are tracked.
        track_rate: f64 in 0.0 to 100.0,
        /// Iterations per tracked phase.
        track_iterations: u32 in 0.0 to 1e6,
    }
}

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
        least_scale: f64 in 1e-6 to 1.0,
        /// Maximum standard deviation.
        #[serde(rename = "scale_max", alias = "greatest_scale")]
        greatest_scale: f64 in 1e-6 to 10.0,
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
        #[serde(rename = "max_num_gaussians", alias = "most")]
        most: u32 in 1.0 to 1_048_576.0,
        /// Density threshold below which a Gaussian is pruned.
        #[serde(rename = "density_min_threshold", alias = "weakest")]
        weakest: f64 in 0.0 to 1e3,
    }
}

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
        #[serde(rename = "max_gaussians", alias = "most")]
        most: u32 in 1.0 to 16_777_216.0,
        /// Opacity threshold below which a Gaussian is pruned.
        #[serde(rename = "min_opacity", alias = "weakest")]
        weakest: f64 in 0.0 to 1.0,
        /// Maximum standard deviation, in extents; larger Gaussians are pruned once opacities have been reset.
        #[serde(rename = "max_scale", alias = "greatest_scale")]
        greatest_scale: f64 in 0.0 to 1e6,
        /// Maximum radius in an image, pixels; larger Gaussians are pruned once opacities have been reset; 0 = no limit. The
        /// public code sets 20, but clears the radii before it reads them.
        #[serde(rename = "max_screen_size", alias = "greatest_radius")]
        greatest_radius: f64 in 0.0 to 1e6,
        /// Interval, in iterations, at which opacities are reset while density control is active; 0 = never.
        #[serde(rename = "opacity_reset_interval", alias = "reset_every")]
        reset_every: u32 in 0.0 to 1e6,
        /// Value that larger opacities are reset to.
        reset_opacity: f64 in 1e-6 to 0.99,
    }
}

section! {
    /// SAX-NeRF's field (`dynamic.form = "lineformer"`), a hash grid and a Lineformer, with the defaults of its code for the
    /// chest.
    Sax, "sax" {
        /// Images that a field is fitted to: "per-phase" (those of its phase; a field per phase) or "pooled" (all; one field).
        static_data: StaticData,
        /// Divide line integrals by the vessels' attenuation where the dataset states it, so that densities, which a
        /// sigmoid keeps below 1, can be near 1.
        normalise: bool,
        /// Half side of the volume that rays cross, mm; 0 = 1.6 radii of the field of view, or the dataset's depth
        /// range where that is less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Half side of the box that the hash grid divides, mm; outside the box, the field has the values at its faces.
        bound_mm: f64 in 1.0 to 1e5,
        /// Levels of the hash grid, an even number; each has two features.
        #[serde(rename = "num_levels", alias = "levels")]
        levels: u32 in 2.0 to 16.0,
        /// Cells along each side of the box in the first level; each further one has twice as many.
        #[serde(rename = "base_resolution", alias = "base")]
        base: u32 in 1.0 to 65_536.0,
        /// Logarithm to base 2 of the maximum number of entries of a level.
        #[serde(rename = "log2_hashmap_size", alias = "log2_table")]
        log2_table: u32 in 4.0 to 24.0,
        /// Windows of a batch.
        #[serde(rename = "window_num", alias = "windows")]
        windows: u32 in 0.0 to 4096.0,
        /// Side of a window, pixels.
        #[serde(rename = "window_size", alias = "window")]
        window: u32 in 1.0 to 256.0,
        /// Single rays of a batch, through pixels outside the windows that show something.
        #[serde(rename = "n_rays", alias = "rays")]
        rays: u32 in 1.0 to 65_535.0,
        /// Samples of a ray, an even number.
        #[serde(rename = "n_samples", alias = "samples")]
        samples: u32 in 2.0 to 4096.0,
        /// Adam's learning rate.
        #[serde(rename = "lrate", alias = "rate")]
        rate: f64 in 1e-12 to 100.0,
        /// Iteration after which the learning rate falls; 0 = never.
        #[serde(rename = "lrate_step", alias = "rate_falls_at")]
        rate_falls_at: u32 in 0.0 to 1e6,
        /// Learning rate after its fall, as a share of the initial rate.
        #[serde(rename = "lrate_gamma", alias = "rate_fall")]
        rate_fall: f64 in 0.0 to 1.0,
    }
}
