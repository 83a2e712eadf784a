//! Settings of NerT-CA: the presets `paper`, `public-code`, `nert-ca` and `fast-mlp`.

use crate::calibrate::settings::CalibrateMode;
use crate::config::choices::{Decay, DynamicTarget, OcclusionRegion};
use crate::config::common::{Calibrate, Render, Train};
use crate::config::fields::{
    Adam, DynamicField, FieldSettings, Loss, March, Network, Occupancy, StaticField, Tensor, check_batches,
};
use crate::config::method::{MethodSettings, Scaled};
use crate::config::section::{section, sections};
use crate::config::{Config, Preset, Shared};
use crate::error::{Error, Result};

/// Decay of Adam's first and second moments: the betas of the authors' code.
const BETAS: [f64; 2] = [0.9, 0.99];

section! {
    /// Batches of rays.
    NertCaRays, "train" {
        /// Rays of a batch.
        rays: u32 in 1.0 to 65_535.0,
    } fixed {
        /// Share of the batch drawn from rays that meet the motion hull.
        motion_share: f64 in 0.0 to 1.0,
    }
}

section! {
    /// Motion hull: where every view shows temporal change.
    NertCaHull, "hull" {
        /// Restrict the dynamic field to it.
        enabled: bool,
    } fixed {
        /// Cells along each side.
        resolution: u32 in 8.0 to 512.0,
        /// A pixel moves, with four views or more, when its range also exceeds this share of the strongest change in its view.
        min_share: f64 in 0.0 to 1.0,
        /// Threshold like `min_share` for fewer than four views: they carve less, so the threshold has to be higher.
        min_share_few_views: f64 in 0.0 to 1.0,
        /// Pixels by which moving regions grow.
        dilate_pixels: u32 in 0.0 to 64.0,
        /// Larger hulls (share of the box) are not used.
        max_share: f64 in 0.0 to 1.0,
    }
}

section! {
    /// The optimiser.
    NertCaAdam, "adam" {} fixed {
        /// Constant added to the denominator.
        epsilon: f64 in 1e-30 to 1.0,
    }
}

sections! {
    /// Settings of a static tensor field and a dynamic network.
    NertCaSettings {
        /// Batches of rays.
        batch: NertCaRays,
        /// Sampling along rays.
        march: March,
        /// The static field.
        static_field: Tensor,
        /// The network of the dynamic field.
        network: Network,
        /// Place and losses of the dynamic field.
        dynamic: DynamicField,
        /// Loss terms.
        loss: Loss,
        /// Motion hull.
        hull: NertCaHull,
        /// Occupancy grid.
        occupancy: Occupancy,
        /// The optimiser.
        adam: NertCaAdam,
    }
}

/// Returns the method as the paper states it (section 4).
pub(super) fn paper() -> Config<NertCaSettings> {
    Config {
        preset: Preset::Paper,
        seed: 1,
        train: Train {
            iterations: 30_000,
            chunk_samples: 524_288,
            iterations_per_submit: 16,
            checkpoint_every: 1000,
            validate_every: 1000,
            stop_at_loss_ratio: 0.0,
        },
        calibrate: Calibrate { mode: CalibrateMode::Off },
        render: Render { render_samples: 256 },
        method: NertCaSettings {
            batch: NertCaRays { rays: 2048, motion_share: 0.0 },
            march: March {
                static_samples: 256,
                dynamic_samples: 256,
                per_ray_depths: true,
                fit_dynamic_range: false,
                fit_static_range: false,
            },
            static_field: Tensor {
                grid: 48,
                ranks: 3,
                half_extent_mm: 50.0,
                lr: 1e-2,
                lr_end: 1e-3,
                decay: Decay::Linear,
                tv: 1e-2,
            },
            network: Network {
                layers: 4,
                width: 128,
                skip_layer: 0,
                latent: 8,
                bands: 10,
                window_iterations: 15_000,
                lr: 1e-1,
                lr_end: 1e-2,
                decay: Decay::Linear,
            },
            dynamic: DynamicField {
                half_extent_mm: 100.0,
                window_start: 0.0,
                delay: 1500,
                occlusion: 1e-8,
                encode_box: false,
                normalised_shift: -2.0,
                best_start: false,
                min_slope: 0.0,
                occlusion_share: 0.2,
                occlusion_region: OcclusionRegion::DepthRange,
            },
            loss: Loss { normalise: false, dynamic_target: DynamicTarget::Absolute, robust: 0.1 },
            hull: NertCaHull {
                enabled: false,
                resolution: 128,
                min_share: 0.1,
                min_share_few_views: 0.1,
                dilate_pixels: 1,
                max_share: 0.35,
            },
            occupancy: Occupancy { enabled: false, cells: 64, start: 15_000 },
            adam: NertCaAdam { epsilon: 1e-8 },
        },
    }
}

/// Applies the differences between the authors' public code and the paper.
pub(super) fn public_code() -> Config<NertCaSettings> {
    let mut config = paper();
    config.preset = Preset::PublicCode;
    let method = &mut config.method;
    method.march.per_ray_depths = false;
    let field = &mut method.static_field;
    (field.lr, field.lr_end, field.decay) = (2e-2, 2e-3, Decay::Exponential);
    let network = &mut method.network;
    (network.layers, network.skip_layer, network.decay) = (5, 4, Decay::Exponential);
    method.dynamic.occlusion_region = OcclusionRegion::LastRay;
    config
}

/// Applies what the public code needs to find vessels on data of other sizes (docs/methods/nert-ca.md): boxes as large as what the views
/// see, and half of the network's rate.
pub(super) fn nert_ca() -> Config<NertCaSettings> {
    let mut config = public_code();
    config.preset = Preset::NertCa;
    let method = &mut config.method;
    method.static_field.half_extent_mm = 0.0;
    (method.network.lr, method.network.lr_end) = (5e-2, 5e-3);
    method.dynamic.half_extent_mm = 0.0;
    config
}

/// The paper's two fields with normalised data, a motion hull and tuned settings.
pub(super) fn fast_mlp() -> Config<NertCaSettings> {
    let Config { train, method: paper, seed, render, .. } = paper();
    Config {
        preset: Preset::FastMlp,
        seed,
        train: Train { iterations: 1200, validate_every: 200, checkpoint_every: 400, ..train },
        calibrate: Calibrate { mode: CalibrateMode::Auto },
        render,
        method: NertCaSettings {
            batch: NertCaRays { rays: 1024, motion_share: 0.85 },
            march: March {
                static_samples: 32,
                dynamic_samples: 128,
                per_ray_depths: true,
                fit_dynamic_range: true,
                fit_static_range: true,
            },
            static_field: Tensor { half_extent_mm: 0.0, tv: 1e-3, ..paper.static_field },
            network: Network { width: 96, bands: 8, window_iterations: 600, lr: 1e-2, lr_end: 3e-4, ..paper.network },
            dynamic: DynamicField {
                half_extent_mm: 0.0,
                window_start: 4.0,
                delay: 0,
                occlusion: 0.0,
                encode_box: true,
                best_start: true,
                min_slope: 1e-3,
                ..paper.dynamic
            },
            loss: Loss { normalise: true, dynamic_target: DynamicTarget::Temporal, ..paper.loss },
            hull: NertCaHull {
                enabled: true,
                resolution: 224,
                min_share: 0.05,
                min_share_few_views: 0.08,
                dilate_pixels: 0,
                ..paper.hull
            },
            occupancy: Occupancy { enabled: true, start: 256, ..paper.occupancy },
            adam: paper.adam,
        },
    }
}

impl MethodSettings for NertCaSettings {
    fn name(&self) -> &'static str {
        "a tensor field and a network"
    }

    fn check(&self, shared: &Shared<'_>) -> Result<()> {
        self.network.check_shape()?;
        let (start, bands) = (self.dynamic.window_start, self.network.bands);
        if start > f64::from(bands) {
            return Err(Error::config("dynamic.window_start", start, format!("exceeds the {bands} frequency bands")));
        }
        self.fields(shared).iter().try_for_each(check_batches)
    }

    fn fields(&self, shared: &Shared<'_>) -> Option<FieldSettings> {
        Some(FieldSettings {
            seed: shared.seed,
            train: shared.train.clone(),
            begin: 0,
            rays: self.batch.rays,
            motion_share: self.batch.motion_share,
            march: self.march.clone(),
            render_samples: shared.render.render_samples,
            along_axis: false,
            static_field: StaticField::Tensor(self.static_field.clone()),
            network: Some(self.network.clone()),
            dynamic: self.dynamic.clone(),
            loss: self.loss.clone(),
            has_hull: self.hull.enabled,
            occupancy: self.occupancy.clone(),
            adam: Adam { beta1: BETAS[0], beta2: BETAS[1], epsilon: self.adam.epsilon, decay_share: 1.0 },
            networks: None,
        })
    }

    fn delay_network(&mut self, iterations: u32) {
        self.dynamic.delay = iterations;
    }

    fn scale(&mut self, scaled: &Scaled) {
        scaled.apply(&mut self.dynamic.delay);
        scaled.apply(&mut self.network.window_iterations);
        scaled.apply(&mut self.occupancy.start);
    }
}
