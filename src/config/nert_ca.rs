//! Settings of NerT-CA: the presets `paper`, `public-code` and `fast-mlp`.

use crate::config::fields::{NETWORK_KEYS, TENSOR_KEYS};
use crate::config::method::MethodSettings;
use crate::config::sections::{Adam, Calibrate, DynamicField, Hull, Loss, March, Occupancy, StaticField, Train};
use crate::config::{
    AdjustMode, CalibrateMode, Config, Decay, DynamicForm, DynamicTarget, OcclusionRegion, Preset, StaticForm,
    dynamic_gaussians, nerf_ca, r2_gaussian, sax_nerf, x_gaussian,
};

/// Returns the method as the paper states it (section 4).
pub(super) fn paper() -> Config {
    Config {
        preset: Preset::Paper,
        seed: 1,
        train: Train {
            iterations: 30_000,
            rays: 2048,
            motion_share: 0.0,
            chunk_samples: 524_288,
            iterations_per_submit: 16,
            checkpoint_every: 1000,
            validate_every: 1000,
            validate_images: 8,
            stop_at_loss_ratio: 0.0,
        },
        calibrate: uncalibrated(),
        march: March {
            static_samples: 256,
            dynamic_samples: 256,
            render_samples: 256,
            per_ray_depths: true,
            fit_dynamic_range: false,
            fit_static_range: false,
            along_axis: false,
        },
        static_field: StaticField {
            form: StaticForm::Tensor,
            grid: 48,
            ranks: 3,
            half_extent_mm: 50.0,
            init_std: 0.01,
            lr: 1e-2,
            lr_end: 1e-3,
            decay: Decay::Linear,
            tv: 1e-2,
            tv_plane: 1e-2,
            tv_line: 1e-3,
        },
        dynamic: DynamicField {
            form: DynamicForm::Network,
            layers: 4,
            width: 128,
            skip_layer: 0,
            latent: 8,
            bands: 10,
            window_start: 0.0,
            window_iterations: 15_000,
            half_extent_mm: 100.0,
            encode_box: false,
            delay: 1500,
            lr: 1e-1,
            lr_end: 1e-2,
            decay: Decay::Linear,
            normalised_shift: -2.0,
            best_start: false,
            min_slope: 0.0,
            occlusion: 1e-8,
            occlusion_share: 0.2,
            occlusion_region: OcclusionRegion::DepthRange,
        },
        loss: Loss { normalise: false, dynamic_target: DynamicTarget::Absolute, robust: 0.0 },
        hull: Hull {
            enabled: false,
            per_phase: false,
            resolution: 128,
            noise_sigmas: 6.0,
            min_share: 0.1,
            min_share_few_views: 0.1,
            vessel_pixels: 3,
            dilate_pixels: 1,
            max_share: 0.35,
        },
        occupancy: Occupancy { enabled: false, cells: 64, start: 15_000, threshold: 0.01 },
        networks: nerf_ca::networks(),
        adam: Adam { beta1: 0.9, beta2: 0.99, epsilon: 1e-8, decay_share: 1.0 },
        gaussians: dynamic_gaussians::gaussians(),
        deformable: dynamic_gaussians::deformable(),
        r2: r2_gaussian::r2(),
        x: x_gaussian::x(),
        sax: sax_nerf::sax(),
    }
}

/// Returns the setting that takes the geometry from the dataset, as in the paper.
pub(super) fn uncalibrated() -> Calibrate {
    Calibrate { mode: CalibrateMode::Off, adjust: AdjustMode::Off }
}

/// Applies the differences between the authors' public code and the paper.
pub(super) fn public_code() -> Config {
    let paper = paper();
    Config {
        preset: Preset::PublicCode,
        march: March { per_ray_depths: false, ..paper.march },
        static_field: StaticField { lr: 2e-2, lr_end: 2e-3, decay: Decay::Exponential, ..paper.static_field },
        dynamic: DynamicField {
            layers: 5,
            skip_layer: 4,
            decay: Decay::Exponential,
            occlusion_region: OcclusionRegion::LastRay,
            ..paper.dynamic
        },
        ..paper
    }
}

/// The paper's two fields with normalised data, a motion hull and tuned settings.
pub(super) fn fast_mlp() -> Config {
    let paper = paper();
    Config {
        preset: Preset::FastMlp,
        train: Train {
            iterations: 1200,
            rays: 1024,
            motion_share: 0.85,
            validate_every: 200,
            checkpoint_every: 400,
            ..paper.train
        },
        calibrate: Calibrate { mode: CalibrateMode::Auto, adjust: AdjustMode::Off },
        march: March {
            static_samples: 32,
            dynamic_samples: 128,
            render_samples: 256,
            per_ray_depths: true,
            fit_dynamic_range: true,
            fit_static_range: true,
            along_axis: false,
        },
        static_field: StaticField { half_extent_mm: 0.0, tv: 1e-3, ..paper.static_field },
        dynamic: DynamicField {
            layers: 4,
            width: 96,
            bands: 8,
            window_start: 4.0,
            window_iterations: 600,
            half_extent_mm: 0.0,
            encode_box: true,
            delay: 0,
            lr: 1e-2,
            lr_end: 3e-4,
            best_start: true,
            min_slope: 1e-3,
            occlusion: 0.0,
            ..paper.dynamic
        },
        loss: Loss { normalise: true, dynamic_target: DynamicTarget::Temporal, robust: 0.1 },
        hull: Hull {
            enabled: true,
            per_phase: true,
            resolution: 224,
            min_share: 0.05,
            min_share_few_views: 0.08,
            dilate_pixels: 0,
            ..paper.hull
        },
        occupancy: Occupancy { enabled: true, start: 256, ..paper.occupancy },
        ..paper
    }
}

/// Settings of the method, for [`MethodKind::settings`](crate::config::method::MethodKind::settings).
pub(super) struct Settings;

impl MethodSettings for Settings {
    fn is_key(&self, preset: Preset, key: &str) -> bool {
        let of_preset: &[&str] = match preset {
            Preset::FastMlp => &["loss.dynamic_target", "hull.enabled"],
            _ => &["dynamic.occlusion", "dynamic.occlusion_share", "loss.normalise"],
        };
        let own = ["dynamic.latent", "dynamic.window_start", "dynamic.delay"];
        [&TENSOR_KEYS[..], &NETWORK_KEYS[..], &own[..], of_preset].iter().any(|keys| keys.contains(&key))
    }
}
