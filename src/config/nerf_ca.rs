//! Settings of NeRF-CA: the preset `nerf-ca`.

use crate::calibrate::settings::CalibrateMode;
use crate::config::choices::{Decay, DynamicTarget, OcclusionRegion};
use crate::config::common::{Calibrate, Render, Train};
use crate::config::fields::{
    Adam, DynamicField, FieldSettings, Loss, March, Network, Networks, Occupancy, Rates, StaticField, check_batches,
};
use crate::config::method::{MethodSettings, Scaled};
use crate::config::section::{section, sections};
use crate::config::{Config, Preset, Shared};
use crate::error::Result;

/// Decay of Adam's first and second moments, as in the public code.
const BETAS: [f64; 2] = [0.9, 0.999];
/// Share of the run over which learning rates fall: 150,000 of 200,000 iterations of the public code.
const DECAY_SHARE: f64 = 0.75;
/// Bands open at the start, as in the public code.
const WINDOW_START: f64 = 1.0;

section! {
    /// Batches of rays.
    NerfCaRays, "train" {
        /// Rays of a batch.
        rays: u32 in 1.0 to 65_535.0,
        /// Share of the batch drawn from rays whose pixel changes.
        motion_share: f64 in 0.0 to 1.0,
    }
}

section! {
    /// Sampling along rays.
    NerfCaMarch, "march" {
        /// Depths per ray for both fields.
        dynamic_samples: u32 in 2.0 to 4096.0,
    } fixed {
        /// Count path lengths along the source-detector axis, not along the ray.
        #[serde(default)] along_axis: bool,
    }
}

section! {
    /// Learning rate of the static field.
    NerfCaStatic, "static" {
        /// Learning rate at the start.
        lr: f64 in 0.0 to 100.0,
        /// Learning rate at the end.
        lr_end: f64 in 0.0 to 100.0,
    }
}

section! {
    /// Losses near the source.
    NerfCaDynamic, "dynamic" {
        /// Share of the depth range, counted from the source, that `networks.near_integral` covers.
        occlusion_share: f64 in 0.0 to 1.0,
    }
}

section! {
    /// The optimiser.
    NerfCaAdam, "adam" {} fixed {
        /// Constant added to the denominator.
        epsilon: f64 in 1e-30 to 1.0,
    }
}

sections! {
    /// Settings of two networks.
    NerfCaSettings {
        /// Batches of rays.
        batch: NerfCaRays,
        /// Sampling along rays.
        march: NerfCaMarch,
        /// Learning rate of the static field.
        static_field: NerfCaStatic,
        /// Shape of both networks, and the learning rate of the dynamic one.
        network: Network,
        /// Losses near the source.
        dynamic: NerfCaDynamic,
        /// Losses.
        networks: Networks,
        /// The optimiser.
        adam: NerfCaAdam,
    }
}

/// NeRF-CA as its public code implements it: two networks, no boxes, and no samples left out. Weights and durations are those of
/// the public code, for a run of 200,000 iterations.
pub(super) fn nerf_ca() -> Config<NerfCaSettings> {
    Config {
        preset: Preset::NerfCa,
        seed: 1,
        train: Train {
            iterations: 200_000,
            chunk_samples: 524_288,
            iterations_per_submit: 16,
            checkpoint_every: 5000,
            validate_every: 5000,
            stop_at_loss_ratio: 0.0,
        },
        calibrate: Calibrate { mode: CalibrateMode::Off },
        render: Render { render_samples: 500 },
        method: NerfCaSettings {
            batch: NerfCaRays { rays: 1024, motion_share: 0.5 },
            march: NerfCaMarch { dynamic_samples: 500, along_axis: true },
            static_field: NerfCaStatic { lr: 1e-3, lr_end: 1e-5 },
            network: Network {
                layers: 5,
                width: 128,
                skip_layer: 0,
                latent: 8,
                bands: 12,
                // A band opens every 12,500 iterations.
                window_iterations: 137_500,
                lr: 1e-3,
                lr_end: 1e-5,
                decay: Decay::Linear,
            },
            // The code selects the near fifth of each ray with one mask, then replaces it with a mask that covers the whole
            // ray.
            dynamic: NerfCaDynamic { occlusion_share: 1.0 },
            networks: Networks {
                delay: 40_000,
                favour_static: 1e-12,
                favour_static_end: 1e-10,
                ray_entropy: 1e-10,
                ray_entropy_end: 1e-8,
                near_integral: 1e-8,
                near_integral_end: 1e-4,
                static_size: 1e-8,
                static_size_end: 1e-15,
                gain: 0.01,
                change_weight: 1.0,
                min_change: 0.03,
                min_integral: 1e-4,
                ramp: 100_000,
                stop_after: 150_000,
                stop_below: 1e-15,
            },
            adam: NerfCaAdam { epsilon: 1e-8 },
        },
    }
}

impl MethodSettings for NerfCaSettings {
    fn name(&self) -> &'static str {
        "two networks"
    }

    fn check(&self, shared: &Shared<'_>) -> Result<()> {
        self.network.check_shape()?;
        self.fields(shared).iter().try_for_each(check_batches)
    }

    fn fields(&self, shared: &Shared<'_>) -> Option<FieldSettings> {
        let samples = self.march.dynamic_samples;
        Some(FieldSettings {
            seed: shared.seed,
            train: shared.train.clone(),
            begin: 0,
            rays: self.batch.rays,
            motion_share: self.batch.motion_share,
            march: March {
                static_samples: samples,
                dynamic_samples: samples,
                per_ray_depths: false,
                fit_dynamic_range: false,
                fit_static_range: false,
            },
            render_samples: shared.render.render_samples,
            along_axis: self.march.along_axis,
            static_field: StaticField::Network(Rates {
                start: self.static_field.lr,
                end: self.static_field.lr_end,
                decay: self.network.decay,
            }),
            network: Some(self.network.clone()),
            dynamic: DynamicField {
                half_extent_mm: 0.0,
                encode_box: false,
                window_start: WINDOW_START,
                delay: 0,
                normalised_shift: 0.0,
                best_start: false,
                min_slope: 0.0,
                occlusion: 0.0,
                occlusion_share: self.dynamic.occlusion_share,
                occlusion_region: OcclusionRegion::DepthRange,
            },
            loss: Loss { normalise: false, dynamic_target: DynamicTarget::Absolute, robust: 0.0 },
            has_hull: false,
            occupancy: Occupancy::NONE,
            adam: Adam { beta1: BETAS[0], beta2: BETAS[1], epsilon: self.adam.epsilon, decay_share: DECAY_SHARE },
            networks: Some(self.networks.clone()),
        })
    }

    fn scale(&mut self, scaled: &Scaled) {
        scaled.apply(&mut self.network.window_iterations);
        scaled.apply(&mut self.networks.delay);
        scaled.apply(&mut self.networks.ramp);
        scaled.apply(&mut self.networks.stop_after);
    }

    fn events(&self) -> Vec<u32> {
        let n = &self.networks;
        vec![n.delay, n.delay.saturating_add(n.ramp), n.stop_after]
    }
}
