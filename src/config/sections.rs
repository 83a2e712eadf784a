//! The sections of a configuration: each hyper-parameter with what it means and the range it may have.

use crate::config::{
    CalibrateMode, Decay, DynamicForm, DynamicTarget, GaussianForm, OcclusionRegion, R2Integral, R2Start, StaticData,
    StaticForm,
};
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
    // A value that is not a number is in no range.
    if value >= low && value <= high {
        return Ok(());
    }
    Err(Error::config(field, value, format!("{low} to {high} is accepted")))
}

fn whole_run() -> f64 {
    1.0
}

section! {
    /// The loop.
    Train, "train" {
        /// Length of the run; schedules refer to it.
        iterations: u32 in 1.0 to 1e6,
        /// Rays of a batch.
        rays: u32 in 1.0 to 65_535.0,
        /// Share of the batch drawn from rays that meet the motion hull; with two networks, from those that change.
        motion_share: f64 in 0.0 to 1.0,
        /// Samples evaluated at once, at most: bounds device memory, not results. A device may allow fewer.
        chunk_samples: u32 in 1024.0 to 1_048_576.0,
        /// Iterations handed to the device at once.
        iterations_per_submit: u32 in 1.0 to 256.0,
        /// Iterations between checkpoints.
        checkpoint_every: u32 in 1.0 to 1e6,
        /// Iterations between validations; 0 turns them off.
        validate_every: u32,
        /// Validation images used during training; evenly spread over all of them.
        validate_images: u32,
        /// Loss, as a multiple of the first one of a start, at which a run stops as diverged; 0 = never. A loss that is not finite
        /// always stops it, and one of 1e6 times the first is warned of.
        #[serde(default)] stop_at_loss_ratio: f64 in 0.0 to 1e30,
    }
}

section! {
    /// Self-calibration: corrections of the views' stated geometry, found in the angiograms before anything else.
    Calibrate, "calibrate" {
        /// What is corrected.
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
        /// Look for the static field only as near and as far as its box reaches.
        fit_static_range: bool,
        /// Count path lengths along the source-detector axis, not along the ray, as NeRF-CA does.
        #[serde(default)] along_axis: bool,
    }
}

section! {
    /// The static field. As a network ("network") it has the dynamic one's layers, and of what is below the learning rate alone.
    StaticField, "static" {
        /// What it is made of: "tensor" (low-rank planes and lines), "network", or "none", which goes with R2-Gaussian,
        /// X-Gaussian and SAX-NeRF alone.
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
        /// How it decays.
        decay: Decay,
        /// Weight of total variation, lambda_TV.
        tv: f64 in 0.0 to 1e6,
        /// Share of the planes in it.
        tv_plane: f64,
        /// Share of the lines in it.
        tv_line: f64,
    }
}

section! {
    /// The dynamic neural field.
    DynamicField, "dynamic" {
        /// What it is where no Gaussians are: "network", or "lineformer" (section `sax`, and of this one nothing else).
        #[serde(default)] form: DynamicForm,
        /// Hidden layers.
        layers: u32 in 1.0 to 16.0,
        /// Neurons per hidden layer, a multiple of 16.
        width: u32 in 16.0 to 1024.0,
        /// Hidden layer (from 1) that sees the encoded input again; 0 = none.
        skip_layer: u32,
        /// Numbers of a phase's latent.
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
        /// Iterations before the field starts. After the first one with it, both fields' moments and learning rates start again.
        delay: u32,
        /// Learning rate at the start.
        lr: f64 in 0.0 to 100.0,
        /// Learning rate at the end.
        lr_end: f64 in 0.0 to 100.0,
        /// How it decays.
        decay: Decay,
        /// Shift inside its softplus when the problem is normalised.
        normalised_shift: f64 in -20.0 to 20.0,
        /// Start, with a temporal target, where the best constant field is instead.
        best_start: bool,
        /// Least slope of its softplus where a ray asks for more, so that the field cannot die; 0 = none.
        least_slope: f64 in 0.0 to 1.0,
        /// Weight of occlusion minimisation, lambda_o.
        occlusion: f64 in 0.0 to 1e6,
        /// Share of the depth range, from the source, it covers; with two networks, that `networks.near_integral` does.
        occlusion_share: f64 in 0.0 to 1.0,
        /// How the region of occlusion minimisation is found: "depth-range" (that share of the depth range) or "last-ray" (that
        /// share of the path length of the batch's last ray).
        #[serde(default)] occlusion_region: OcclusionRegion,
    }
}

section! {
    /// Loss terms.
    Loss, "loss" {
        /// Scale both fields and residuals by the data, so that numbers are near 1.
        normalise: bool,
        /// What drives the dynamic field.
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
        /// Carve each phase from its own images, not only from what moves over the whole beat.
        per_phase: bool,
        /// Cells along each side.
        resolution: u32 in 8.0 to 512.0,
        /// A pixel moves when its temporal range exceeds what noise gives by this many standard deviations.
        noise_sigmas: f64 in 0.0 to 1e3,
        /// A pixel moves, with four views or more, when its range also exceeds this share of the strongest change in its view.
        min_share: f64 in 0.0 to 1.0,
        /// As `min_share`, with fewer than four views: each carves less, so more has to be asked of it.
        min_share_few_views: f64 in 0.0 to 1.0,
        /// Half width of the widest vessel, pixels: structures as thin as that may hide in the still background.
        /// 0 trusts each pixel's minimum over the phases.
        vessel_pixels: u32 in 0.0 to 1024.0,
        /// Pixels by which moving regions grow.
        dilate_pixels: u32 in 0.0 to 64.0,
        /// Larger hulls (share of the box) are not used.
        max_share: f64 in 0.0 to 1.0,
    }
}

section! {
    /// Occupancy learned while training: where the dynamic field is empty, samples are mostly left out.
    Occupancy, "occupancy" {
        /// Heed it.
        enabled: bool,
        /// Cells along each side of the dynamic field's box, for each phase.
        cells: u32 in 2.0 to 256.0,
        /// Iterations of the dynamic field before it is heeded.
        start: u32 in 0.0 to 1e6,
        /// Attenuation up to which a sample is empty, as a share of the dynamic field's scale: a typical vessel's when the
        /// problem is normalised, 0.01 per mm otherwise.
        threshold: f64 in 0.0 to 1.0,
    }
}

section! {
    /// Two networks as the fields (`static.form = "network"`), as NeRF-CA has them. Weights of losses go from one value to
    /// another on a straight line, then stay.
    Networks, "networks" {
        /// Attenuation of either field where its softplus is 1, per world unit.
        gain: f64 in 1e-9 to 1e6,
        /// What a ray weighs more whose pixel changes most over the beat, in what passes of the X-rays.
        change_weight: f64 in 0.0 to 1e3,
        /// Change, as a share of the view's greatest, beyond which `train.motion_share` counts a ray as one that moves.
        least_change: f64 in 0.0 to 1.0,
        /// Line integral of the dynamic field from which its entropy along a ray counts though the ray does not change.
        least_integral: f64 in 0.0 to 1e6,
        /// Iterations before the shares' entropy and near samples count.
        delay: u32 in 0.0 to 1e6,
        /// Iterations that weights take from the first value to the last.
        ramp: u32 in 1.0 to 1e6,
        /// First weight of the entropy of the fields' shares at samples: each is to belong to one.
        favour_static: f64 in 0.0 to 1e6,
        /// Last weight of it.
        favour_static_end: f64 in 0.0 to 1e6,
        /// First weight of the entropy of the dynamic field along rays.
        ray_entropy: f64 in 0.0 to 1e6,
        /// Last weight of it.
        ray_entropy_end: f64 in 0.0 to 1e6,
        /// First weight of the dynamic field's integral over the share `dynamic.occlusion_share` of the ray that is near.
        near_integral: f64 in 0.0 to 1e6,
        /// Last weight of it.
        near_integral_end: f64 in 0.0 to 1e6,
        /// First weight of the static field's integrals over intervals, and their squares.
        static_size: f64 in 0.0 to 1e6,
        /// Last weight of it.
        static_size_end: f64 in 0.0 to 1e6,
        /// Iterations after which learning ends when an entropy has vanished; 0 = it does not.
        stop_after: u32 in 0.0 to 1e6,
        /// Entropy that has vanished, before it is weighted.
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
        /// Added to the denominator.
        epsilon: f64 in 1e-30 to 1.0,
        /// Share of the run over which learning rates go from start to end; then they stay.
        #[serde(default = "whole_run")] decay_share: f64 in 0.001 to 1.0,
    }
}

section! {
    /// Gaussians as the moving field. Lengths are pixels at the isocentre of images whose smaller side has 100, and grow with
    /// the images; line integrals are shares of the views' strongest change.
    Gaussians, "gaussians" {
        /// What the moving field is made of: "none" (the network), "phase", "tree", "auto", or "r2" (section
        /// `r2`, and of this one nothing else).
        form: GaussianForm,
        /// Iterations, each over all images.
        iterations: u32 in 1.0 to 1e6,
        /// Gaussians seeded per phase.
        count: u32 in 1.0 to 1_048_576.0,
        /// First scale.
        first_scale: f64 in 0.01 to 100.0,
        /// Least scale; noise raises it by up to half, where vessels are wide enough.
        least_scale: f64 in 0.01 to 100.0,
        /// Greatest scale.
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
        /// What rates fall to, as a share of themselves.
        last_rate: f64 in 0.0 to 1.0,
        /// Where the loss bends from square to linear.
        bend: f64 in 1e-6 to 1e3,
        /// Noise at which a pixel counts 0.7 times; 0 = all pixels count alike.
        noise_scale: f64 in 0.0 to 1e3,
        /// Standard deviations at which a Gaussian ends.
        cut: f64 in 1.0 to 10.0,
        /// Iteration at which weak Gaussians are dropped and new ones placed where data are missing; 0 = never.
        grow_at: u32 in 0.0 to 1e6,
        /// New Gaussians per phase, as a share of `count`.
        grow_share: f64 in 0.0 to 10.0,
        /// Amplitude below which a Gaussian is dropped.
        weakest: f64 in 0.0 to 1e3,
        /// Iteration at which Gaussians too faint for vessels are dropped: they stand for what else moves; 0 = never.
        clear_at: u32 in 0.0 to 1e6,
        /// Density below which a Gaussian is too faint, as a share of the vessels'.
        faint: f64 in 0.0 to 1.0,
        /// Distance within which Gaussians belong to one vessel, a length as the scales are: broad ones that stand alone are dropped when all iterations are
        /// done; 0 = never. Runs from before it was a setting did not.
        #[serde(default)] link: f64 in 0.0 to 1e3,
        /// Missing line integral from which a Gaussian is placed; also its first density.
        missing: f64 in 1e-6 to 1e3,
        /// Iterations after which the still background is estimated anew from what the Gaussians leave of the images, and
        /// again after as many; not while rates fall; 0 = never.
        background_every: u32 in 0.0 to 1e6,
    }
}

section! {
    /// One set of Gaussians that moves over the beat. Lengths are those of `gaussians`.
    Tree, "tree" {
        /// Iterations of a set per phase, before the tree is made of one of them.
        warm_iterations: u32 in 1.0 to 1e6,
        /// Amplitude from which a Gaussian of the phase of rest is taken into the tree, share of the views' strongest change.
        take: f64 in 0.0 to 1e3,
        /// Distance of the grid's nodes.
        node: f64 in 1.0 to 1e4,
        /// Adam's rate of displacements.
        grid_rate: f64 in 0.0 to 100.0,
        /// Penalty on squared differences of neighbouring nodes.
        smoothness: f64 in 0.0 to 1e6,
        /// Harmonics of a Gaussian's own motion.
        harmonics: u32 in 0.0 to 64.0,
        /// Adam's rate of own motion.
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
    /// Gaussians as R2-Gaussian fits them (`gaussians.form = "r2"`), with what its code uses as defaults. Its volume is a
    /// cube around the isocentre; lengths are shares of that cube's side unless they are called rates, which count half
    /// sides.
    R2, "r2" {
        /// Which images a set of Gaussians sees: "per-phase" (those of its phase; a set per phase) or "pooled" (all; one
        /// set).
        static_data: StaticData,
        /// Where the fit begins: "fdk" (at voxels of a filtered back-projection) or "random".
        init: R2Start,
        /// What a pixel sees of a Gaussian: "affine" (as published: exact for the Gaussian's affine picture around its centre) or
        /// "exact" (along the pixel's own ray).
        #[serde(default)] integral: R2Integral,
        /// Divide line integrals by the vessels' attenuation where the dataset states it, so that densities are near 1.
        normalise: bool,
        /// Half side of the volume, mm; 0 = 1.6 radii of the field of view, or the dataset's depth range where that is
        /// less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Voxels along each side of the volume, for the back-projection and the box of total variation.
        voxels: u32 in 8.0 to 512.0,
        /// Gaussians of a set at the start.
        count: u32 in 1.0 to 1_048_576.0,
        /// Density of a Gaussian at the start, as a share of the back-projection there.
        density_share: f64 in 1e-6 to 1e3,
        /// Back-projection beyond which a Gaussian may begin at a voxel.
        candidate: f64 in 0.0 to 1e3,
        /// Least standard deviation.
        least_scale: f64 in 1e-6 to 1.0,
        /// Greatest standard deviation.
        greatest_scale: f64 in 1e-6 to 10.0,
        /// Adam's rate of positions at the start; rates fall by a constant factor per iteration.
        position_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of positions at the end.
        position_rate_end: f64 in 1e-12 to 100.0,
        /// Adam's rate of densities, before the softplus, at the start.
        density_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of densities at the end.
        density_rate_end: f64 in 1e-12 to 100.0,
        /// Adam's rate of scales, before the sigmoid, at the start.
        scale_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of scales at the end.
        scale_rate_end: f64 in 1e-12 to 100.0,
        /// Adam's rate of quaternions at the start.
        rotation_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of quaternions at the end.
        rotation_rate_end: f64 in 1e-12 to 100.0,
        /// Weight of 1 - SSIM beside the mean absolute difference, which has 1.
        ssim: f64 in 0.0 to 1e3,
        /// Weight of total variation in a box of voxels.
        tv: f64 in 0.0 to 1e3,
        /// Voxels along each side of that box, which is elsewhere in each iteration.
        tv_box: u32 in 2.0 to 128.0,
        /// Let total variation move Gaussians: what its code computes, but scales by the square of a voxel's side by
        /// mistake, so that it is nothing.
        tv_moves_centres: bool,
        /// Iterations after which Gaussians are added and taken away, and again after as many; 0 = never.
        densify_every: u32 in 0.0 to 1e6,
        /// Iteration beyond which that begins.
        densify_from: u32 in 0.0 to 1e6,
        /// Iteration from which it no longer happens.
        densify_until: u32 in 0.0 to 1e6,
        /// Mean gradient of the loss by a centre, in half images, from which a Gaussian is cloned or split.
        densify_gradient: f64 in 0.0 to 1e6,
        /// Greatest standard deviation up to which a Gaussian is cloned, and beyond which it is split.
        size_limit: f64 in 0.0 to 10.0,
        /// Most Gaussians of a set.
        most: u32 in 1.0 to 1_048_576.0,
        /// Density below which a Gaussian is taken away.
        weakest: f64 in 0.0 to 1e3,
    }
}

section! {
    /// Gaussians as X-Gaussian fits them (`gaussians.form = "x"`), with what its code uses for most of its scenes as defaults.
    X, "x" {
        /// Which images a set of Gaussians sees: "per-phase" (those of its phase; a set per phase) or "pooled" (all; one set).
        static_data: StaticData,
        /// Divide line integrals by the vessels' attenuation where the dataset states it, before they are clamped.
        normalise: bool,
        /// What line integrals are clamped to, from 0 on, before each image is scaled to 0 to 1; 0 = not at all.
        clamp: f64 in 0.0 to 1e6,
        /// Half side of the volume, mm; 0 = 1.6 radii of the field of view, or the dataset's depth range where that is less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Voxels along each side of the volume.
        voxels: u32 in 1.0 to 2048.0,
        /// Voxels from the centre where a Gaussian begins to the next, along each axis.
        interval: u32 in 1.0 to 2048.0,
        /// Extent of the scene, mm, which rates of positions and bounds of scales count in; 0 = 1.1 times the largest distance of
        /// a source from the mean of the sources.
        extent_mm: f64 in 0.0 to 1e6,
        /// Opacity at the start.
        first_opacity: f64 in 1e-6 to 0.99,
        /// Adam's rate of positions at the start, extents; it falls by a constant factor per iteration.
        position_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of positions at the end.
        position_rate_end: f64 in 1e-12 to 100.0,
        /// Adam's rate of colours' first coefficients; those of higher degrees have a twentieth.
        intensity_rate: f64 in 1e-12 to 100.0,
        /// Iterations after which colours gain a degree, up to three, which makes intensities faster; 0 = never.
        degree_every: u32 in 0.0 to 1e6,
        /// Adam's rate of opacities, before the sigmoid.
        opacity_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of logarithms of scales.
        scale_rate: f64 in 1e-12 to 100.0,
        /// Adam's rate of quaternions.
        rotation_rate: f64 in 1e-12 to 100.0,
        /// Weight of 1 - SSIM; the mean absolute difference has the rest of 1.
        ssim: f64 in 0.0 to 0.99,
        /// Iterations after which Gaussians are added and taken away, and again after as many; 0 = never.
        densify_every: u32 in 0.0 to 1e6,
        /// Iteration beyond which that begins.
        densify_from: u32 in 0.0 to 1e6,
        /// Iteration from which it no longer happens.
        densify_until: u32 in 0.0 to 1e6,
        /// Mean gradient of the loss by a centre, in half images, from which a Gaussian is cloned or split.
        densify_gradient: f64 in 0.0 to 1e6,
        /// Greatest standard deviation, extents, up to which a Gaussian is cloned, and beyond which it is split.
        size_limit: f64 in 0.0 to 10.0,
        /// Most Gaussians of a set.
        most: u32 in 1.0 to 16_777_216.0,
        /// Opacity below which a Gaussian is taken away.
        weakest: f64 in 0.0 to 1.0,
        /// Greatest standard deviation, extents, beyond which a Gaussian is taken away once opacities have been reset.
        greatest_scale: f64 in 0.0 to 1e6,
        /// Radius in a picture, pixels, beyond which a Gaussian is taken away then, too; 0 = whatever it is. The code says 20, but
        /// forgets radii before it looks at them.
        greatest_radius: f64 in 0.0 to 1e6,
        /// Iterations after which opacities are reset, while Gaussians are added; 0 = never.
        reset_every: u32 in 0.0 to 1e6,
        /// What larger opacities are reset to.
        reset_opacity: f64 in 1e-6 to 0.99,
    }
}

section! {
    /// SAX-NeRF's field (`dynamic.form = "lineformer"`), a hash grid and a Lineformer, with what its code uses as
    /// defaults for the chest.
    Sax, "sax" {
        /// Which images a field sees: "per-phase" (those of its phase; a field per phase) or "pooled" (all; one field).
        static_data: StaticData,
        /// Divide line integrals by the vessels' attenuation where the dataset states it, so that densities, which a
        /// sigmoid keeps below 1, can be near 1.
        normalise: bool,
        /// Half side of the volume that rays cross, mm; 0 = 1.6 radii of the field of view, or the dataset's depth
        /// range where that is less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Half side of the box that the hash grid divides, mm; beyond it, rays see what is at its faces.
        bound_mm: f64 in 1.0 to 1e5,
        /// Levels of the hash grid, an even number; each has two features.
        levels: u32 in 2.0 to 16.0,
        /// Cells along each side of the box in the first level; each further one has twice as many.
        base: u32 in 1.0 to 65_536.0,
        /// Logarithm to base 2 of the entries that a level has at most.
        log2_table: u32 in 4.0 to 24.0,
        /// Windows of a batch.
        windows: u32 in 0.0 to 4096.0,
        /// Side of a window, pixels.
        window: u32 in 1.0 to 256.0,
        /// Single rays of a batch, through pixels outside the windows that show something.
        rays: u32 in 1.0 to 65_535.0,
        /// Samples of a ray, an even number.
        samples: u32 in 2.0 to 4096.0,
        /// Adam's rate.
        rate: f64 in 1e-12 to 100.0,
        /// Iteration after which it falls; 0 = it does not.
        rate_falls_at: u32 in 0.0 to 1e6,
        /// What it falls to, as a share of itself.
        rate_fall: f64 in 0.0 to 1.0,
    }
}
