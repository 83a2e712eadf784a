//! Constants, rates and turns of a fit as X-Gaussian does it.

use crate::config::Config;
use crate::config::sections::X;
use crate::config::sections::XSettings;
use crate::fitting::RING_LENGTH;
use crate::fitting::sets::seed_of_set;
use crate::gaussians::blending::{FIXED_POINT_BITS, NEAREST_MM, TILE};
use crate::gaussians::comparison::picture_parts;
use crate::kernels::layout::{BlendSetup, GaussianSetup, PictureSetup, PictureTurn, XSchedule};
use crate::methods::x_gaussian::data::XData;
use crate::methods::x_gaussian::densify::{densifies, resets};

/// Decay of Adam's first and second moments, as in the public code.
const BETAS: [f64; 2] = [0.9, 0.999];
/// Constant added to the denominator of Adam's update, as in the public code.
const EPSILON: f64 = 1e-15;

/// Rates of an intensity by the colours' degree, as shares of that of their first coefficients. A colour of degree d is
/// one half plus the sum of (d + 1)^2 coefficients, each times a constant, whatever the direction, and each has Adam's
/// step, of the gradient's sign; those beyond the first with a twentieth of the rate. So rates add up, times the
/// constants' sizes.
const RATES_BY_DEGREE: [f64; 4] = [0.282_094_79, 0.355_385_17, 0.562_350_72, 0.902_514_34];

/// Weight of the mean absolute difference in the loss.
fn absolute_weight(settings: &X) -> f64 {
    1.0 - settings.ssim
}

/// Constants that stages share with other fits of Gaussians.
pub fn gaussian_setup(data: &XData, config: &Config<XSettings>) -> GaussianSetup {
    let n_sets = data.n_sets() as u32;
    let n_pixels = data.n_pixels() as u32;
    GaussianSetup {
        n_views: 1,
        n_phases: n_sets,
        width: data.width as u32,
        height: data.height as u32,
        fixed_point: 2f32.powi(FIXED_POINT_BITS),
        // Each set has its own loss; their mean is reported.
        loss_weight: (absolute_weight(&config.x) / f64::from(n_sets)) as f32,
        beta1: BETAS[0] as f32,
        beta2: BETAS[1] as f32,
        epsilon: EPSILON as f32,
        ring_length: RING_LENGTH,
        n_images: n_sets,
        image_stride: n_pixels.next_multiple_of(4),
        n_loss_parts: n_sets * picture_parts(n_pixels),
        ..GaussianSetup::default()
    }
}

/// Constants of the stages that compare pictures, which weigh SSIM beside an absolute difference of weight 1.
pub fn comparing_setup(data: &XData, settings: &X) -> PictureSetup {
    PictureSetup { n_sets: data.n_sets() as u32, ssim_weight: (settings.ssim / absolute_weight(settings)) as f32 }
}

/// Constants of this method, of pictures of `size` (columns, rows) and lists with room for `capacity`.
pub fn blend_setup(settings: &X, n_sets: u32, [columns, rows]: [u32; 2], capacity: u32) -> BlendSetup {
    BlendSetup {
        nearest: NEAREST_MM as f32,
        n_sets,
        tile_columns: columns.div_ceil(TILE),
        tile_rows: rows.div_ceil(TILE),
        capacity,
        absolute_weight: absolute_weight(settings) as f32,
    }
}

/// Share of the colours' rate that an intensity has in iteration `step`, counted from 1.
fn intensity_share(settings: &X, step: u32) -> f64 {
    let degree = step.checked_div(settings.degree_every).unwrap_or(0) as usize;
    RATES_BY_DEGREE[degree.min(RATES_BY_DEGREE.len() - 1)]
}

/// One row per iteration, and one more for timing; positions are in mm, in a scene of `extent_mm`.
pub fn schedule(config: &Config<XSettings>, extent_mm: f64) -> Vec<XSchedule> {
    let (x, n) = (&config.x, config.train.iterations);
    let mut updates = 0;
    let row = |step: u32| {
        let is_update = !densifies(x, step);
        updates += i32::from(is_update);
        let share = (f64::from(step) / f64::from(n)).min(1.0);
        let position_rate = extent_mm * x.position_rate * (x.position_rate_end / x.position_rate).powf(share);
        let bias = |beta: f64| (1.0 - beta.powi(updates.max(1))) as f32;
        XSchedule {
            position_rate: position_rate as f32,
            opacity_rate: if resets(x, step) { 0.0 } else { x.opacity_rate as f32 },
            scale_rate: x.scale_rate as f32,
            intensity_rate: (x.intensity_rate * intensity_share(x, step)) as f32,
            rotation_rate: x.rotation_rate as f32,
            bias1: bias(BETAS[0]),
            bias2: bias(BETAS[1]),
            updates: u32::from(is_update),
        }
    };
    (1..=n + 1).map(row).collect()
}

/// Turns of each set in each iteration of the schedule: an image, in an order that is drawn anew when all have been seen.
pub fn turns(data: &XData, config: &Config<XSettings>) -> Vec<PictureTurn> {
    let turn = |step: u32, set: usize| PictureTurn {
        image: data.sets.image_of_turn(set, seed_of_set(config.seed, set), step),
        ..PictureTurn::default()
    };
    (0..=config.train.iterations).flat_map(|step| (0..data.n_sets()).map(move |set| turn(step, set))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    /// The constants of colours, degree by degree.
    const COLOURS: [&[f64]; 4] = [
        &[0.282_094_8],
        &[0.488_602_5, 0.488_602_5, 0.488_602_5],
        &[1.092_548_4, 1.092_548_4, 0.315_391_6, 1.092_548_4, 0.546_274_2],
        &[0.590_043_6, 2.890_611_4, 0.457_045_8, 0.373_176_3, 0.457_045_8, 1.445_305_7, 0.590_043_6],
    ];

    #[test]
    fn rates_of_intensities_are_those_of_their_coefficients() {
        let mut rate = 0.0;
        for (degree, constants) in COLOURS.iter().enumerate() {
            rate += constants.iter().sum::<f64>() / if degree == 0 { 1.0 } else { 20.0 };
            assert!((RATES_BY_DEGREE[degree] - rate).abs() < 5e-7, "{degree}: {rate}");
        }
    }

    #[test]
    fn rates_fall_and_density_control_takes_no_step() {
        let config = Config::preset(Preset::XGaussian).of::<XSettings>().unwrap();
        let rows = schedule(&config, 437.0);
        assert_eq!(rows.len(), 20_001);
        let close = |got: f32, want: f64| assert!((f64::from(got) / want - 1.0).abs() < 1e-5, "{got} {want}");
        close(rows[19_999].position_rate, 437.0 * 1.9e-6);
        close(rows[9999].position_rate, 437.0 * 1.9e-5);
        assert_eq!(rows.iter().filter(|row| row.updates == 0).count(), 37);
        close(rows[998].intensity_rate, 0.002 * RATES_BY_DEGREE[0]);
        close(rows[999].intensity_rate, 0.002 * RATES_BY_DEGREE[1]);
        close(rows[19_000].intensity_rate, 0.002 * RATES_BY_DEGREE[3]);
        assert_eq!((rows[3998].opacity_rate > 0.0, rows[3999].opacity_rate), (true, 0.0));
        close(rows[700].bias2, 1.0 - 0.999f64.powi(700));
        let mut steady = config;
        steady.x.degree_every = 0;
        close(schedule(&steady, 1.0)[9000].intensity_rate, 0.002 * RATES_BY_DEGREE[0]);
    }
}
