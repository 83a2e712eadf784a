//! Settings of fields that rays are marched through, which NerT-CA, NeRF-CA and the static field behind Gaussians share.

use crate::config::forms::{Decay, DynamicForm, DynamicTarget, OcclusionRegion, StaticForm};
use crate::config::section::section;
use serde::{Deserialize, Serialize};

/// Keys of a run with a static tensor field.
pub(super) const TENSOR_KEYS: [&str; 9] = [
    "train.rays",
    "march.static_samples",
    "static.grid",
    "static.ranks",
    "static.half_extent_mm",
    "static.lr",
    "static.lr_end",
    "static.tv",
    "dynamic.half_extent_mm",
];
/// Keys of a run whose dynamic field is a network.
pub(super) const NETWORK_KEYS: [&str; 10] = [
    "train.rays",
    "march.dynamic_samples",
    "static.lr",
    "static.lr_end",
    "dynamic.layers",
    "dynamic.width",
    "dynamic.bands",
    "dynamic.window_iterations",
    "dynamic.lr",
    "dynamic.lr_end",
];

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
        #[serde(alias = "least_slope")]
        min_slope: f64 in 0.0 to 1.0,
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
