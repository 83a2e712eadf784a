//! Settings of fields that rays are marched through: sections that several methods share, and all settings of such fields as
//! [`crate::fields`] reads them.

use crate::config::choices::{Decay, DynamicTarget, OcclusionRegion};
use crate::config::common::Train;
use crate::config::section::section;
use crate::error::{Error, Result};

section! {
    /// A static field of low-rank planes and lines.
    Tensor, "static" {
        /// Cells per axis, D.
        grid: u32 in 2.0 to 512.0,
        /// Half side of its box, mm; 0 = 1.6 radii of the field of view, or the dataset's depth range where that is less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Learning rate at the start.
        lr: f64 in 0.0 to 100.0,
        /// Learning rate at the end.
        lr_end: f64 in 0.0 to 100.0,
        /// Weight of the total variation of planes and lines.
        tv: f64 in 0.0 to 1e6,
    } fixed {
        /// Ranks per mode, R.
        ranks: u32 in 1.0 to 64.0,
        /// Course of the learning rate.
        decay: Decay,
    }
}

section! {
    /// A network on encoded coordinates and a latent vector per phase, as the dynamic field.
    Network, "dynamic" {
        /// Hidden layers.
        layers: u32 in 1.0 to 16.0,
        /// Neurons per hidden layer, a multiple of 16.
        width: u32 in 16.0 to 1024.0,
        /// Iterations until all frequency bands of the encoding are open, counted from the delay.
        window_iterations: u32,
        /// Learning rate at the start.
        lr: f64 in 0.0 to 100.0,
        /// Learning rate at the end.
        lr_end: f64 in 0.0 to 100.0,
    } fixed {
        /// Frequency bands of the encoding, as many as the publication or the preset has.
        bands: u32 in 1.0 to 16.0,
        /// Hidden layer (from 1) that sees the encoded input again; 0 = none.
        skip_layer: u32,
        /// Length of a phase's latent vector, a multiple of 4.
        latent: u32 in 1.0 to 64.0,
        /// Course of the learning rate.
        decay: Decay,
    }
}

section! {
    /// Losses of two networks whose sum is the attenuation. Weights change linearly from their first value to their last one and
    /// then stay constant.
    Networks, "networks" {
        /// Iterations before the losses `favour_static` and `near_integral` count.
        delay: u32 in 0.0 to 1e6,
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
    } fixed {
        /// Attenuation of either field where its softplus is 1, per world unit.
        gain: f64 in 1e-9 to 1e6,
        /// Extra weight of rays whose pixel changes: a ray weighs 1 + this times the change of its X-ray transmission over the
        /// beat, from 0 to 1 in each view.
        change_weight: f64 in 0.0 to 1e3,
        /// Change, as a share of the view's maximum, above which `train.motion_share` counts a ray as moving.
        #[serde(alias = "least_change")] min_change: f64 in 0.0 to 1.0,
        /// Minimum line integral of the dynamic field at which its entropy along a ray counts although the ray does not change.
        #[serde(alias = "least_integral")] min_integral: f64 in 0.0 to 1e6,
        /// Iterations over which weights change from the first value to the last.
        ramp: u32 in 1.0 to 1e6,
        /// Iterations after which learning ends when an entropy has vanished; 0 = never.
        stop_after: u32 in 0.0 to 1e6,
        /// Threshold of an unweighted entropy below which it counts as vanished.
        stop_below: f64 in 0.0 to 1.0,
    }
}

section! {
    /// Sampling along rays.
    March, "march" {
        /// Depths per ray for the static field.
        static_samples: u32 in 2.0 to 4096.0,
        /// Depths per ray for the dynamic field.
        dynamic_samples: u32 in 2.0 to 4096.0,
    } fixed {
        /// Draw depths for each ray instead of once per iteration.
        per_ray_depths: bool,
        /// Spread the dynamic field's depths over its own box instead of the whole depth range.
        fit_dynamic_range: bool,
        /// Spread the static field's depths over its own box instead of the whole depth range.
        fit_static_range: bool,
    }
}

section! {
    /// Place and losses of the dynamic field.
    DynamicField, "dynamic" {
        /// Half side of its box, mm; 0 = the field of view.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Bands open when the field starts.
        window_start: f64 in 0.0 to 16.0,
        /// Iterations before the field starts. After the first iteration with it, moments and learning rates of both fields
        /// start again.
        delay: u32,
        /// Weight of occlusion minimisation, lambda_o.
        occlusion: f64 in 0.0 to 1e6,
    } fixed {
        /// Encode coordinates relative to the field's box instead of world units.
        encode_box: bool,
        /// Shift inside its softplus when the problem is normalised.
        normalised_shift: f64 in -20.0 to 20.0,
        /// With a temporal target, start at the best constant field instead.
        best_start: bool,
        /// Minimum slope of its softplus where a ray demands more attenuation, so that the gradient cannot vanish; 0 = none.
        #[serde(alias = "least_slope")] min_slope: f64 in 0.0 to 1.0,
        /// Share of the depth range, counted from the source, that occlusion minimisation covers, or the losses of two networks.
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
    } fixed {
        /// Residual of the dynamic field, as a share of strong temporal change, from which its loss grows linearly with a
        /// temporal target, when the problem is normalised; 0 = squared throughout.
        robust: f64 in 0.0 to 1e3,
    }
}

section! {
    /// Occupancy grid learned during training: where the dynamic field is empty, most samples are left out.
    Occupancy, "occupancy" {} fixed {
        /// Leave out samples where the field is empty.
        enabled: bool,
        /// Cells along each side of the dynamic field's box, for each phase.
        cells: u32 in 2.0 to 256.0,
        /// Iterations of the dynamic field before samples are left out.
        start: u32 in 0.0 to 1e6,
    }
}

impl Occupancy {
    /// No grid: no samples are left out.
    pub const NONE: Occupancy = Occupancy { enabled: false, cells: 0, start: 0 };
}

impl Network {
    /// Refuses shapes that no kernel computes.
    pub(super) fn check_shape(&self) -> Result<()> {
        if !self.width.is_multiple_of(16) {
            return Err(Error::config("dynamic.width", self.width, "is not a multiple of 16"));
        }
        if !self.latent.is_multiple_of(4) {
            return Err(Error::config("dynamic.latent", self.latent, "is not a multiple of 4"));
        }
        if self.skip_layer == 1 || self.skip_layer > self.layers {
            let problem = "is neither 0 (no skip connection) nor a hidden layer from the second on";
            return Err(Error::config("dynamic.skip_layer", self.skip_layer, problem));
        }
        Ok(())
    }
}

/// Settings of fields that rays are marched through.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldSettings {
    /// Seed of initialisation, ray order and depths.
    pub seed: u32,
    /// The training loop.
    pub train: Train,
    /// Iteration at which the fit of the fields begins: the end of that of Gaussians in front of them, otherwise 0.
    pub begin: u32,
    /// Rays of a batch.
    pub rays: u32,
    /// Share of the batch drawn from rays of the motion list.
    pub motion_share: f64,
    /// Sampling along rays.
    pub march: March,
    /// Depths per ray when rendering.
    pub render_samples: u32,
    /// Count path lengths along the source-detector axis, not along the ray.
    pub along_axis: bool,
    /// The static field.
    pub static_field: StaticField,
    /// The network of the dynamic field; none where Gaussians are the dynamic field.
    pub network: Option<Network>,
    /// Place and losses of the dynamic field.
    pub dynamic: DynamicField,
    /// Loss terms.
    pub loss: Loss,
    /// Whether a motion hull confines the dynamic field.
    pub has_hull: bool,
    /// Occupancy grid learned during training.
    pub occupancy: Occupancy,
    /// The optimiser.
    pub adam: Adam,
    /// Losses of two networks; none where the static field is no network.
    pub networks: Option<Networks>,
}

/// A static field.
#[derive(Debug, Clone, PartialEq)]
pub enum StaticField {
    /// Planes and lines.
    Tensor(Tensor),
    /// A network like that of the dynamic field, but without latents; the attenuations of both are added at the same samples.
    Network(Rates),
}

/// Course of a learning rate from start to end.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rates {
    /// Learning rate at the start.
    pub start: f64,
    /// Learning rate at the end.
    pub end: f64,
    /// Course in between.
    pub decay: Decay,
}

impl StaticField {
    /// Returns the planes and lines, where the field consists of them.
    pub fn tensor(&self) -> Option<&Tensor> {
        match self {
            StaticField::Tensor(tensor) => Some(tensor),
            StaticField::Network(_) => None,
        }
    }

    /// Returns the course of the learning rate.
    pub fn rates(&self) -> Rates {
        match self {
            StaticField::Tensor(tensor) => Rates { start: tensor.lr, end: tensor.lr_end, decay: tensor.decay },
            StaticField::Network(rates) => *rates,
        }
    }
}

/// Adam.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Adam {
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Constant added to the denominator.
    pub epsilon: f64,
    /// Share of the run over which learning rates change from start to end; then they stay constant.
    pub decay_share: f64,
}

/// Refuses batches whose rays cannot be numbered, and chunks that do not hold the samples of one ray.
///
/// # Errors
/// [`Error::Config`] naming the key.
pub(super) fn check_batches(settings: &FieldSettings) -> Result<()> {
    let (train, march) = (&settings.train, &settings.march);
    if march.static_samples.max(march.dynamic_samples).max(settings.render_samples) > train.chunk_samples {
        return Err(Error::config(
            "train.chunk_samples",
            train.chunk_samples,
            "is less than the number of samples of one ray (march.static_samples, dynamic_samples, render_samples)",
        ));
    }
    if u64::from(train.iterations) * u64::from(settings.rays) > u64::from(u32::MAX) {
        return Err(Error::config("train.iterations", train.iterations, "iterations x rays must stay below 2^32"));
    }
    Ok(())
}
