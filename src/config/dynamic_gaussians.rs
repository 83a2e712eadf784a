//! Settings of Gaussians in front of a static tensor field: the preset `fast`.

use crate::config::fields::TENSOR_KEYS;
use crate::config::method::MethodSettings;
use crate::config::section::section;
use crate::config::sections::{Calibrate, DynamicField, March, Occupancy, StaticField, Train};
use crate::config::{AdjustMode, Config, GaussianForm, Preset, nert_ca};
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

fn one_fit() -> u32 {
    1
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
        #[serde(alias = "least_scale")]
        min_scale: f64 in 0.01 to 100.0,
        /// Maximum scale.
        #[serde(alias = "greatest_scale")]
        max_scale: f64 in 0.01 to 100.0,
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
        #[serde(alias = "weakest")]
        prune_threshold: f64 in 0.0 to 1e3,
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
        /// Number of fits with different seeds whose mean is the dynamic field; 0 = three where images are noisy, views were adjusted, or
        /// blades hide much of three views, five with two views, else one; 1 is the default for older files without this setting.
        #[serde(default = "one_fit")] fits: u32 in 0.0 to 9.0,
        /// Leave out a catheter: Gaussians of a deformable set whose motion ends along a line.
        #[serde(default)] without_catheter: bool,
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

/// Returns the defaults of the Gaussians for all presets; the paper does not use Gaussians.
///
/// The numbers were tuned on the default phantom. `docs/tried.md` holds the measurements of `clear_at`, `faint`, `min_scale` and `link`;
/// those of the other numbers were not kept, so a change of them needs measurements of its own.
pub(super) fn gaussians() -> Gaussians {
    Gaussians {
        form: GaussianForm::None,
        iterations: 120,
        count: 500,
        first_scale: 0.8,
        min_scale: 0.4,
        max_scale: 3.0,
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
        prune_threshold: 0.01,
        clear_at: 65,
        faint: 0.2,
        link: 4.0,
        missing: 0.03,
        background_every: 40,
        fits: 1,
        without_catheter: false,
    }
}

/// Returns the defaults of the deformable set of Gaussians for all presets; the paper does not use it.
///
/// The numbers were tuned on the default phantom. `docs/tried.md` holds the measurements of `smoothness` and `node`; those of the other numbers
/// were not kept, so a change of them needs measurements of its own.
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

/// Gaussians in front of the static field of the preset `fast-mlp`.
pub(super) fn fast() -> Config {
    let mlp = nert_ca::fast_mlp();
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
        calibrate: Calibrate { adjust: AdjustMode::Auto, ..mlp.calibrate },
        march: March { dynamic_samples: 2, ..mlp.march },
        // Three or four views do not determine how a low-rank field looks from other angles; smoothness does. Few iterations
        // need large steps.
        static_field: StaticField { tv: 100.0, lr: 3e-2, lr_end: 3e-3, ..mlp.static_field },
        // There is no network; its settings are recorded only.
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
        gaussians: Gaussians { form: GaussianForm::Auto, fits: 0, ..mlp.gaussians },
        ..mlp
    }
}

/// Settings of the method, for [`MethodKind::settings`](crate::config::method::MethodKind::settings).
pub(super) struct Settings;

impl MethodSettings for Settings {
    fn check(&self, config: &Config) -> Result<()> {
        let Gaussians { min_scale, max_scale, .. } = config.gaussians;
        if min_scale > max_scale {
            return Err(Error::config(
                "gaussians.min_scale",
                min_scale,
                format!("exceeds gaussians.max_scale = {max_scale}"),
            ));
        }
        Ok(())
    }

    fn is_key(&self, _: Preset, key: &str) -> bool {
        TENSOR_KEYS.contains(&key)
            || [
                "calibrate.adjust",
                "gaussians.form",
                "gaussians.iterations",
                "gaussians.count",
                "gaussians.fits",
                "gaussians.without_catheter",
            ]
            .contains(&key)
    }
}
