//! Settings of NeRF-CA: the preset `nerf-ca`.

use crate::config::fields::NETWORK_KEYS;
use crate::config::method::{MethodSettings, Scaled};
use crate::config::section::section;
use crate::config::sections::{Adam, DynamicField, March, StaticField, Train};
use crate::config::{Config, DynamicTarget, OcclusionRegion, Preset, StaticForm, nert_ca};
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

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
        #[serde(alias = "least_change")]
        min_change: f64 in 0.0 to 1.0,
        /// Minimum line integral of the dynamic field at which its entropy along a ray counts although the ray does not change.
        #[serde(alias = "least_integral")]
        min_integral: f64 in 0.0 to 1e6,
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

/// Weights and durations of NeRF-CA's public code, for a run of 200,000 iterations.
pub(super) fn networks() -> Networks {
    Networks {
        gain: 0.01,
        change_weight: 1.0,
        min_change: 0.03,
        min_integral: 1e-4,
        delay: 40_000,
        ramp: 100_000,
        favour_static: 1e-12,
        favour_static_end: 1e-10,
        ray_entropy: 1e-10,
        ray_entropy_end: 1e-8,
        near_integral: 1e-8,
        near_integral_end: 1e-4,
        static_size: 1e-8,
        static_size_end: 1e-15,
        stop_after: 150_000,
        stop_below: 1e-15,
    }
}

/// NeRF-CA as its public code implements it: two networks, no boxes, and no samples left out.
pub(super) fn nerf_ca() -> Config {
    let paper = nert_ca::paper();
    Config {
        preset: Preset::NerfCa,
        train: Train {
            iterations: 200_000,
            rays: 1024,
            motion_share: 0.5,
            checkpoint_every: 5000,
            validate_every: 5000,
            ..paper.train
        },
        march: March {
            static_samples: 500,
            dynamic_samples: 500,
            render_samples: 500,
            per_ray_depths: false,
            along_axis: true,
            ..paper.march
        },
        static_field: StaticField { form: StaticForm::Network, lr: 1e-3, lr_end: 1e-5, ..paper.static_field },
        dynamic: DynamicField {
            layers: 5,
            bands: 12,
            window_start: 1.0,
            // A band opens every 12,500 iterations.
            window_iterations: 137_500,
            delay: 0,
            lr: 1e-3,
            lr_end: 1e-5,
            occlusion: 0.0,
            // The code selects the near fifth of each ray with one mask, then replaces it with a mask that covers the whole
            // ray.
            occlusion_share: 1.0,
            ..paper.dynamic
        },
        adam: Adam { beta2: 0.999, decay_share: 0.75, ..paper.adam },
        ..paper
    }
}

/// Constants of NeRF-CA's public code.
const CONSTANTS: [&str; 7] =
    ["gain", "change_weight", "min_change", "min_integral", "ramp", "stop_after", "stop_below"];

/// Settings of the method, for [`MethodKind::settings`](crate::config::method::MethodKind::settings).
pub(super) struct Settings;

impl MethodSettings for Settings {
    fn check(&self, config: &Config) -> Result<()> {
        let form = "is not supported with static.form = \"network\"";
        let refuse = |field: &str, value: &dyn std::fmt::Display, instead: &str| {
            Err(Error::config(field, value, format!("{form}: {instead}")))
        };
        for (field, is_on) in [
            ("hull.enabled", config.hull.enabled),
            ("occupancy.enabled", config.occupancy.enabled),
            ("loss.normalise", config.loss.normalise),
            ("dynamic.encode_box", config.dynamic.encode_box),
            ("march.fit_dynamic_range", config.march.fit_dynamic_range),
            ("march.fit_static_range", config.march.fit_static_range),
        ] {
            if is_on {
                return refuse(field, &true, "both fields are evaluated everywhere, in world units; set it to false");
            }
        }
        if config.loss.dynamic_target != DynamicTarget::Absolute {
            return refuse(
                "loss.dynamic_target",
                &"temporal",
                "both fields are trained on the same residual; set it to \"absolute\"",
            );
        }
        for (field, value) in [
            ("dynamic.delay", f64::from(config.dynamic.delay)),
            ("dynamic.min_slope", config.dynamic.min_slope),
            ("dynamic.occlusion", config.dynamic.occlusion),
        ] {
            if value != 0.0 {
                let instead = "set it to 0 (networks.near_integral is the weight near the source; networks.delay and \
                               networks.ramp are its times)";
                return refuse(field, &value, instead);
            }
        }
        if config.dynamic.occlusion_region != OcclusionRegion::DepthRange {
            return refuse(
                "dynamic.occlusion_region",
                &"last-ray",
                "it belongs to dynamic.occlusion, which is not used; set it to \"depth-range\"",
            );
        }
        let preset = Config::preset(config.preset);
        for (field, value, unused) in [
            ("dynamic.half_extent_mm", config.dynamic.half_extent_mm, preset.dynamic.half_extent_mm),
            ("dynamic.normalised_shift", config.dynamic.normalised_shift, preset.dynamic.normalised_shift),
            ("march.static_samples", config.march.static_samples.into(), preset.march.static_samples.into()),
        ] {
            if value != unused {
                let instead = format!("it has no effect there; leave it at the preset's value, {unused}");
                return refuse(field, &value, &instead);
            }
        }
        Ok(())
    }

    fn is_key(&self, _: Preset, key: &str) -> bool {
        let of_networks = key.strip_prefix("networks.").is_some_and(|name| !CONSTANTS.contains(&name));
        of_networks || NETWORK_KEYS.contains(&key) || ["train.motion_share", "dynamic.occlusion_share"].contains(&key)
    }

    fn schedule(&self, config: &Config, scaled: &Scaled) -> Vec<(&'static str, u32)> {
        let n = &config.networks;
        vec![
            ("networks.delay", scaled.count(n.delay)),
            ("networks.ramp", scaled.count(n.ramp)),
            ("networks.stop_after", scaled.count(n.stop_after)),
        ]
    }

    fn events(&self, config: &Config) -> Vec<u32> {
        let n = &config.networks;
        vec![n.delay, n.delay.saturating_add(n.ramp), n.stop_after]
    }
}
