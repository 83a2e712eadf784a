//! Settings of SAX-NeRF: the preset `sax-nerf`.

use crate::choice::Choice;
use crate::config::checks::check_alone;
use crate::config::method::{MethodSettings, Scaled};
use crate::config::section::section;
use crate::config::sections::{Adam, DynamicField, March, StaticField, Train};
use crate::config::{Config, DynamicForm, GaussianForm, Preset, StaticData, StaticForm, nert_ca};
use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};

/// Maximum number of cells along a side of the hash grid's box that f32 coordinates can resolve.
const MAX_CELLS: u64 = 1 << 20;

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
pub(super) fn sax_nerf() -> Config {
    let paper = nert_ca::paper();
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
        // There is no network; its settings are recorded only.
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

/// Constants of SAX-NeRF's public code, and our choice of units.
const CONSTANTS: [&str; 3] = ["normalise", "base_resolution", "lrate_gamma"];

/// Settings of the method, for [`MethodKind::settings`](crate::config::method::MethodKind::settings).
pub(super) struct Settings;

impl MethodSettings for Settings {
    fn check(&self, config: &Config) -> Result<()> {
        check_alone(config)?;
        let gaussians = config.gaussians.form;
        if gaussians != GaussianForm::None {
            let problem = "is not supported with dynamic.form = \"lineformer\": only one of the two settings can choose the field; set \
                           it to \"none\"";
            return Err(Error::config("gaussians.form", gaussians.name(), problem));
        }
        let sax = &config.sax;
        for (field, value) in [("sax.num_levels", sax.levels), ("sax.n_samples", sax.samples)] {
            if value % 2 != 0 {
                return Err(Error::config(field, value, "is not an even number"));
            }
        }
        let finest = u64::from(sax.base) << (sax.levels - 1);
        if finest > MAX_CELLS {
            let problem = format!(
                "the finest of {} levels would have {finest} cells along a side; at most {MAX_CELLS} are supported: \
                 lower sax.base_resolution or sax.num_levels",
                sax.levels
            );
            return Err(Error::config("sax.base_resolution", sax.base, problem));
        }
        Ok(())
    }

    fn is_key(&self, _: Preset, key: &str) -> bool {
        key.strip_prefix("sax.").is_some_and(|name| !CONSTANTS.contains(&name))
    }

    fn schedule(&self, config: &Config, scaled: &Scaled) -> Vec<(&'static str, u32)> {
        vec![("sax.lrate_step", scaled.count(config.sax.rate_falls_at))]
    }

    fn events(&self, config: &Config) -> Vec<u32> {
        vec![config.sax.rate_falls_at]
    }

    /// The only event of the method lies within the last iterations of the publication.
    fn shorten(&self, config: &mut Config, iterations: u32) {
        config.sax.rate_falls_at = config.sax.rate_falls_at.min(iterations / 2);
    }
}
