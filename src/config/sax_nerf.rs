//! Settings of SAX-NeRF: the preset `sax-nerf`.

use crate::calibrate::settings::CalibrateMode;
use crate::config::choices::StaticData;
use crate::config::common::{Calibrate, Render, Train};
use crate::config::method::{MethodSettings, Scaled};
use crate::config::section::{section, sections};
use crate::config::{Config, Preset, Shared};
use crate::error::{Error, Result};

/// Maximum number of cells along a side of the hash grid's box that f32 coordinates can resolve.
const MAX_CELLS: u64 = 1 << 20;

section! {
    /// SAX-NeRF's field: a hash grid and a Lineformer, with the defaults of its code for the
    /// chest.
    Sax, "sax" {
        /// Images that a field is fitted to: "per-phase" (those of its phase; a field per phase) or "pooled" (all; one field).
        static_data: StaticData,
        /// Half side of the volume that rays cross, mm; 0 = 1.6 radii of the field of view, or the dataset's depth
        /// range where that is less.
        half_extent_mm: f64 in 0.0 to 1e5,
        /// Half side of the box that the hash grid divides, mm; outside the box, the field has the values at its faces.
        bound_mm: f64 in 1.0 to 1e5,
        /// Levels of the hash grid, an even number; each has two features.
        #[serde(alias = "levels")] levels = "num_levels": u32 in 2.0 to 16.0,
        /// Logarithm to base 2 of the maximum number of entries of a level.
        #[serde(alias = "log2_table")] log2_table = "log2_hashmap_size": u32 in 4.0 to 24.0,
        /// Windows of a batch.
        #[serde(alias = "windows")] windows = "window_num": u32 in 0.0 to 4096.0,
        /// Side of a window, pixels.
        #[serde(alias = "window")] window = "window_size": u32 in 1.0 to 256.0,
        /// Single rays of a batch, through pixels outside the windows that show something.
        #[serde(alias = "rays")] rays = "n_rays": u32 in 1.0 to 65_535.0,
        /// Samples of a ray, an even number.
        #[serde(alias = "samples")] samples = "n_samples": u32 in 2.0 to 4096.0,
        /// Adam's learning rate.
        #[serde(alias = "rate")] rate = "lrate": f64 in 1e-12 to 100.0,
        /// Iteration after which the learning rate falls; 0 = never.
        #[serde(alias = "rate_falls_at")] rate_falls_at = "lrate_step": u32 in 0.0 to 1e6,
    } fixed {
        /// Cells along each side of the box in the first level; each further one has twice as many.
        #[serde(alias = "base")] base = "base_resolution": u32 in 1.0 to 65_536.0,
    }
}

sections! {
    /// Settings of a hash grid and a Lineformer.
    SaxSettings {
        /// Grid, batches and learning rate.
        sax: Sax,
    }
}

/// SAX-NeRF as its public code implements it: a static method, fitted to the whole images of each phase. The numbers are those of the
/// public code for the chest. Its rate falls after 1500 of 1501 passes over the images; here the count assumes three images.
pub(super) fn sax_nerf() -> Config<SaxSettings> {
    Config {
        preset: Preset::SaxNerf,
        seed: 1,
        train: Train {
            iterations: 4503,
            chunk_samples: 524_288,
            iterations_per_submit: 10,
            checkpoint_every: 1500,
            validate_every: 500,
            stop_at_loss_ratio: 0.0,
        },
        calibrate: Calibrate { mode: CalibrateMode::Off },
        render: Render { render_samples: 2 },
        method: SaxSettings {
            sax: Sax {
                static_data: StaticData::PerPhase,
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
            },
        },
    }
}

impl MethodSettings for SaxSettings {
    fn name(&self) -> &'static str {
        "SAX-NeRF"
    }

    fn check(&self, _: &Shared<'_>) -> Result<()> {
        let sax = &self.sax;
        for (field, value) in [("sax.num_levels", sax.levels), ("sax.n_samples", sax.samples)] {
            if value % 2 != 0 {
                return Err(Error::config(field, value, "is not an even number"));
            }
        }
        let finest = u64::from(sax.base) << (sax.levels - 1);
        if finest > MAX_CELLS {
            let problem = format!(
                "the finest level would have {finest} cells along a side, {} at the first level; at most {MAX_CELLS} are \
                 supported",
                sax.base
            );
            return Err(Error::config("sax.num_levels", sax.levels, problem));
        }
        Ok(())
    }

    fn scale(&mut self, scaled: &Scaled) {
        scaled.apply(&mut self.sax.rate_falls_at);
    }

    fn events(&self) -> Vec<u32> {
        vec![self.sax.rate_falls_at]
    }

    /// The only event of the method lies within the last iterations of the publication.
    fn shorten(&mut self, _: &mut Train, iterations: u32, _: u32) {
        self.sax.rate_falls_at = self.sax.rate_falls_at.min(iterations / 2);
    }
}
