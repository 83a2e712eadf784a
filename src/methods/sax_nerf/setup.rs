//! Constants and learning rates of a fit of SAX-NeRF.

use crate::config::Config;
use crate::config::sections::Sax;
use crate::config::sections::SaxSettings;
use crate::fitting::{FIXED_POINT_BITS, RING_LENGTH};
use crate::kernels::layout::{FieldUpdate, SaxSetup, Schedule, Setup};
use crate::methods::sax_nerf::data::SaxData;
use crate::methods::sax_nerf::field::{SaxField, SaxShape};
use crate::methods::sax_nerf::lineformer::{PART_SAMPLES, chunks};

/// Learning rate after its fall, as a share of the initial rate, as in the public code.
const RATE_FALL: f64 = 0.1;
/// Decay of Adam's first and second moments, as in the public code.
const BETAS: [f64; 2] = [0.9, 0.999];
/// Constant added to the denominator of Adam's update, as in the public code.
pub const EPSILON: f64 = 1e-8;

/// Returns the constants of a field that do not depend on the target of drawing or fitting.
fn field_setup(field: &SaxField) -> SaxSetup {
    SaxSetup {
        n_levels: field.shape.levels,
        bound: field.bound as f32,
        near: field.depths[0] as f32,
        far: field.depths[1] as f32,
        n_samples: field.samples,
        n_weights: field.shape.n_weights() as u32,
        n_grid: field.shape.n_grid() as u32,
        n_sets: field.n_sets as u32,
        fixed_point_bits: FIXED_POINT_BITS,
        ring_length: RING_LENGTH,
        ..SaxSetup::default()
    }
}

/// Returns the number of rays of a batch.
pub fn n_rays(settings: &Sax) -> u32 {
    settings.windows * settings.window * settings.window + settings.rays
}

/// Returns the maximum number of parts into which a chunk of samples is divided for sums.
pub fn n_parts(n_rays: u32, n_samples: u32) -> u32 {
    chunks(n_rays, n_samples).iter().map(|chunk| chunk.n.div_ceil(PART_SAMPLES)).max().unwrap_or(1)
}

/// Returns the constants of a fit.
pub fn fit_setup(field: &SaxField, data: &SaxData, settings: &Sax) -> SaxSetup {
    let rays = n_rays(settings);
    SaxSetup {
        jitter: 1,
        n_rays: rays,
        n_windows: settings.windows,
        window: settings.window,
        width: data.width as u32,
        height: data.height as u32,
        n_groups: n_parts(rays, settings.samples),
        ..field_setup(field)
    }
}

/// Returns the constants of drawing, with regular depths.
pub fn drawing_setup(field: &SaxField) -> SaxSetup {
    SaxSetup { jitter: 0, ..field_setup(field) }
}

/// Returns the constants of the optimiser, which treats all parameters as those of a static field.
pub fn adam_setup(shape: SaxShape) -> Setup {
    let n = shape.n_params() as u32;
    Setup {
        static_params: n,
        n_params: n,
        beta1: BETAS[0] as f32,
        beta2: BETAS[1] as f32,
        epsilon: EPSILON as f32,
        ..Setup::default()
    }
}

/// Returns one row per iteration and one more for an iteration that is timed after the end.
pub fn schedule(config: &Config<SaxSettings>) -> Vec<Schedule> {
    let sax = &config.sax;
    let row = |step: u32| {
        let bias = |beta: f64| (1.0 - beta.powf(f64::from(step + 1))) as f32;
        let has_fallen = sax.rate_falls_at > 0 && step >= sax.rate_falls_at;
        let static_update = FieldUpdate {
            rate: (sax.rate * if has_fallen { RATE_FALL } else { 1.0 }) as f32,
            restart: 0,
            bias_correction1: bias(BETAS[0]),
            bias_correction2: bias(BETAS[1]),
        };
        Schedule { static_update, ..Schedule::default() }
    };
    (0..=config.train.iterations).map(row).collect()
}

/// Returns the field of a fit of `data`, without its parameters.
pub fn outline(data: &SaxData, settings: &Sax, step: u32) -> SaxField {
    SaxField {
        shape: SaxShape::of(settings),
        bound: settings.bound_mm / crate::geometry::MM_PER_UNIT,
        depths: data.depths,
        samples: settings.samples,
        attenuation: data.attenuation,
        n_sets: data.n_sets(),
        params: Vec::new(),
        step,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    #[test]
    fn the_rate_falls_once_and_biases_count_updates() {
        let config = Config::preset(Preset::SaxNerf).of::<SaxSettings>().unwrap();
        let rows = schedule(&config);
        assert_eq!(rows.len(), 4504);
        assert_eq!((rows[0].static_update.rate, rows[4499].static_update.rate), (1e-3, 1e-3));
        assert!((rows[4500].static_update.rate / 1e-4 - 1.0).abs() < 1e-6);
        assert!((rows[0].static_update.bias_correction1 - 0.1).abs() < 1e-7);
        assert!((f64::from(rows[999].static_update.bias_correction2) - (1.0 - 0.999f64.powi(1000))).abs() < 1e-6);
        assert_eq!(n_rays(&config.sax), 2048);
    }
}
