//! The presets.

use crate::config::sections::{
    Adam, Calibrate, Deformable, DynamicField, Gaussians, Hull, Loss, March, Networks, Occupancy, R2, Sax, StaticField,
    Train, X,
};
use crate::config::{
    CalibrateMode, Config, Decay, DynamicForm, DynamicTarget, GaussianForm, OcclusionRegion, Preset, R2Integral,
    R2Start, StaticData, StaticForm,
};

impl Config {
    /// Defaults of a preset.
    pub fn preset(preset: Preset) -> Config {
        match preset {
            Preset::Fast => fast(fast_mlp(paper())),
            Preset::FastMlp => fast_mlp(paper()),
            Preset::Paper => paper(),
            Preset::PublicCode => public_code(paper()),
            Preset::NerfCa => nerf_ca(paper()),
            Preset::R2Gaussian => r2_gaussian(paper()),
            Preset::XGaussian => x_gaussian(paper()),
            Preset::SaxNerf => sax_nerf(paper()),
        }
    }
}

/// Returns the method as the paper states it (section 4).
fn paper() -> Config {
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
            least_slope: 0.0,
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
        networks: networks(),
        adam: Adam { beta1: 0.9, beta2: 0.99, epsilon: 1e-8, decay_share: 1.0 },
        gaussians: gaussians(),
        deformable: deformable(),
        r2: r2(),
        x: x(),
        sax: sax(),
    }
}

/// Returns the setting that takes the geometry from the dataset, as in the paper.
pub(super) fn uncalibrated() -> Calibrate {
    Calibrate { mode: CalibrateMode::Off }
}

/// Returns the defaults of the Gaussians for all presets; the paper does not use Gaussians.
pub(super) fn gaussians() -> Gaussians {
    Gaussians {
        form: GaussianForm::None,
        iterations: 120,
        count: 500,
        first_scale: 0.8,
        least_scale: 0.4,
        greatest_scale: 3.0,
        position_rate: 0.05,
        scale_rate: 0.03,
        rotation_rate: 0.03,
        density_rate: 0.08,
        fall_share: 0.3,
        last_rate: 0.05,
        bend: 0.05,
        noise_scale: 0.05,
        cut: 3.2,
        grow_at: 50,
        grow_share: 0.15,
        weakest: 0.01,
        clear_at: 65,
        faint: 0.2,
        link: 4.0,
        missing: 0.03,
        background_every: 40,
    }
}

/// Returns the defaults of the deformable set of Gaussians for all presets; the paper does not use it.
pub(super) fn deformable() -> Deformable {
    Deformable {
        warm_iterations: 60,
        take: 0.03,
        node: 18.0,
        grid_rate: 0.03,
        smoothness: 0.002,
        harmonics: 4,
        own_rate: 0.02,
        own_penalty: 0.3,
        track_blur: 1.5,
        track_rate: 0.25,
        track_iterations: 25,
    }
}

/// Applies the differences between the authors' public code and the paper.
fn public_code(paper: Config) -> Config {
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

/// Weights and durations of NeRF-CA's public code, for a run of 200,000 iterations.
pub(super) fn networks() -> Networks {
    Networks {
        gain: 0.01,
        change_weight: 1.0,
        least_change: 0.03,
        least_integral: 1e-4,
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
fn nerf_ca(paper: Config) -> Config {
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
        least_scale: 0.0005,
        greatest_scale: 0.5,
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
        most: 500_000,
        weakest: 1e-5,
    }
}

/// R2-Gaussian as its public code implements it: a static method, fitted to the whole images of each phase.
fn r2_gaussian(paper: Config) -> Config {
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
        // The network is never evaluated; the smallest one takes hardly any memory.
        dynamic: DynamicField { layers: 1, width: 16, latent: 4, bands: 1, delay: 0, ..paper.dynamic },
        adam: Adam { beta2: 0.999, epsilon: 1e-15, ..paper.adam },
        gaussians: Gaussians { form: GaussianForm::R2, ..paper.gaussians },
        ..paper
    }
}

/// The constants of X-Gaussian's public code for most of its scenes, for a run of 20,000 iterations.
pub(super) fn x() -> X {
    X {
        static_data: StaticData::PerPhase,
        normalise: true,
        clamp: 1.0,
        half_extent_mm: 0.0,
        voxels: 256,
        interval: 8,
        extent_mm: 0.0,
        first_opacity: 0.1,
        position_rate: 1.9e-4,
        position_rate_end: 1.9e-6,
        intensity_rate: 0.002,
        degree_every: 1000,
        opacity_rate: 0.008,
        scale_rate: 0.005,
        rotation_rate: 0.001,
        ssim: 0.2,
        densify_every: 200,
        densify_from: 500,
        densify_until: 8000,
        densify_gradient: 2.6e-5,
        size_limit: 0.01,
        most: 500_000,
        weakest: 0.005,
        greatest_scale: 0.1,
        greatest_radius: 0.0,
        reset_every: 4000,
        reset_opacity: 0.01,
    }
}

/// X-Gaussian as its public code implements it: a static method, fitted to the normalised images of each phase.
fn x_gaussian(paper: Config) -> Config {
    let r2 = r2_gaussian(paper);
    Config {
        preset: Preset::XGaussian,
        train: Train { iterations: 20_000, ..r2.train },
        gaussians: Gaussians { form: GaussianForm::X, ..r2.gaussians },
        ..r2
    }
}

/// The constants of SAX-NeRF's public code for the chest. Its rate falls after 1500 of 1501 passes over the images; here the
/// count assumes three images.
pub(super) fn sax() -> Sax {
    Sax {
        static_data: StaticData::PerPhase,
        normalise: true,
        half_extent_mm: 0.0,
        bound_mm: 300.0,
        levels: 16,
        base: 16,
        log2_table: 19,
        windows: 16,
        window: 8,
        rays: 1024,
        samples: 256,
        rate: 1e-3,
        rate_falls_at: 4500,
        rate_fall: 0.1,
    }
}

/// SAX-NeRF as its public code implements it: a static method, fitted to the whole images of each phase.
fn sax_nerf(paper: Config) -> Config {
    Config {
        preset: Preset::SaxNerf,
        train: Train {
            iterations: 4503,
            iterations_per_submit: 10,
            checkpoint_every: 1500,
            validate_every: 500,
            ..paper.train
        },
        // Rays are marched through neither field, and there is no static field.
        march: March { static_samples: 2, dynamic_samples: 2, render_samples: 2, ..paper.march },
        static_field: StaticField { form: StaticForm::None, ..paper.static_field },
        // The network is never evaluated; the smallest one takes hardly any memory.
        dynamic: DynamicField {
            form: DynamicForm::Lineformer,
            layers: 1,
            width: 16,
            latent: 4,
            bands: 1,
            delay: 0,
            ..paper.dynamic
        },
        adam: Adam { beta2: 0.999, ..paper.adam },
        ..paper
    }
}

/// Gaussians in front of the static field of [`fast_mlp`].
fn fast(mlp: Config) -> Config {
    Config {
        preset: Preset::Fast,
        train: Train {
            iterations: 300,
            rays: 256,
            motion_share: 0.0,
            // Must divide the numbers of iterations between changes of the number of Gaussians and of the background.
            iterations_per_submit: 10,
            checkpoint_every: 100,
            validate_every: 0,
            ..mlp.train
        },
        march: March { dynamic_samples: 2, ..mlp.march },
        // Three or four views do not determine how a low-rank field looks from other angles; smoothness does. Few iterations
        // need large steps.
        static_field: StaticField { tv: 100.0, lr: 3e-2, lr_end: 3e-3, ..mlp.static_field },
        // The network is never evaluated; the smallest one takes hardly any memory.
        dynamic: DynamicField {
            layers: 1,
            width: 16,
            latent: 4,
            bands: 1,
            window_start: 0.0,
            best_start: false,
            ..mlp.dynamic
        },
        occupancy: Occupancy { enabled: false, ..mlp.occupancy },
        gaussians: Gaussians { form: GaussianForm::Auto, ..mlp.gaussians },
        ..mlp
    }
}

/// The paper's two fields with normalised data, a motion hull and tuned settings.
fn fast_mlp(paper: Config) -> Config {
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
        calibrate: Calibrate { mode: CalibrateMode::Auto },
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
            least_slope: 1e-3,
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
