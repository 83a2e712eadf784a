//! Constants, rates and turns of a fit as R2-Gaussian does it.

use crate::config::sections::R2;
use crate::config::sections::R2Settings;
use crate::config::{Config, R2Integral};
use crate::fitting::RING_LENGTH;
use crate::fitting::sets::seed_of_set;
use crate::gaussians::comparison::picture_parts;
use crate::kernels::layout::{GaussianSetup, PictureSetup, PictureTurn, R2Schedule, R2Setup};
use crate::methods::r2_gaussian::data::R2Data;
use crate::methods::r2_gaussian::densify::densifies;
use crate::methods::r2_gaussian::parameters::ScaleBounds;
use crate::methods::r2_gaussian::stages::box_parts;
use crate::random::{STREAM_BOX, uniform01};

/// Decay of Adam's first and second moments, as in the public code.
const BETAS: [f64; 2] = [0.9, 0.999];
/// Constant added to the denominator of Adam's update, as in the public code.
const EPSILON: f64 = 1e-15;

/// Half side of the square in which a Gaussian is seen, standard deviations along its longest axis.
const CUT: f32 = 3.0;
/// Learning rates at the end, as in the public code: of positions, of densities before the softplus, of scales before the sigmoid, and of
/// quaternions.
const LAST_RATES: [f64; 4] = [2e-5, 1e-3, 5e-4, 1e-4];
/// Bits behind the point of the integer sums: pictures and densities up to 512, in steps of 2.4e-7.
const FIXED_POINT_BITS: i32 = 22;

/// Constants that stages share with other fits of Gaussians.
pub fn gaussian_setup(data: &R2Data, config: &Config<R2Settings>) -> GaussianSetup {
    let bounds = ScaleBounds::of(&config.r2);
    let n_sets = data.n_sets() as u32;
    let n_pixels = data.n_pixels() as u32;
    let parts = picture_parts(n_pixels) + if config.r2.tv > 0.0 { box_parts(config.r2.tv_box) } else { 0 };
    GaussianSetup {
        n_views: 1,
        n_phases: n_sets,
        width: data.width as u32,
        height: data.height as u32,
        cut: CUT,
        min_scale: bounds.min as f32,
        max_scale: bounds.max as f32,
        fixed_point: 2f32.powi(FIXED_POINT_BITS),
        // Each set has its own loss; their mean is reported.
        loss_weight: 1.0 / n_sets as f32,
        beta1: BETAS[0] as f32,
        beta2: BETAS[1] as f32,
        epsilon: EPSILON as f32,
        ring_length: RING_LENGTH,
        n_images: n_sets,
        image_stride: n_pixels.next_multiple_of(4),
        n_loss_parts: n_sets * parts,
        ..GaussianSetup::default()
    }
}

/// Constants of a fit: those of all Gaussians, those of this method, and those of the comparison of pictures.
pub type R2Setups<'a> = (&'a GaussianSetup, &'a R2Setup, &'a PictureSetup);

/// Constants of the comparison of pictures.
pub fn picture_setup(data: &R2Data, settings: &R2) -> PictureSetup {
    PictureSetup { n_sets: data.n_sets() as u32, ssim_weight: settings.ssim as f32 }
}

/// Constants of this method.
pub fn r2_setup(data: &R2Data, settings: &R2) -> R2Setup {
    R2Setup {
        n_sets: data.n_sets() as u32,
        box_side: settings.tv_box,
        voxel: (2.0 / f64::from(settings.voxels)) as f32,
        tv_weight: settings.tv as f32,
        tv_moves_centres: u32::from(settings.tv_moves_centres),
        exact: u32::from(settings.integral == R2Integral::Exact),
    }
}

/// One row per iteration, and one more for timing.
pub fn schedule(config: &Config<R2Settings>) -> Vec<R2Schedule> {
    let (r2, n) = (&config.r2, config.train.iterations);
    let mut updates = 0;
    let row = |step: u32| {
        let is_update = !densifies(r2, step);
        updates += i32::from(is_update);
        let rate =
            |start: f64, end: f64| (start * (end / start).powf((f64::from(step) / f64::from(n)).min(1.0))) as f32;
        let bias = |beta: f64| (1.0 - beta.powi(updates.max(1))) as f32;
        R2Schedule {
            position_rate: rate(r2.position_rate, LAST_RATES[0]),
            density_rate: rate(r2.density_rate, LAST_RATES[1]),
            scale_rate: rate(r2.scale_rate, LAST_RATES[2]),
            rotation_rate: rate(r2.rotation_rate, LAST_RATES[3]),
            bias1: bias(BETAS[0]),
            bias2: bias(BETAS[1]),
            updates: u32::from(is_update),
        }
    };
    (1..=n + 1).map(row).collect()
}

/// Turns of each set in each iteration of the schedule: an image, in an order that is drawn anew when all have been seen, and a
/// box anywhere in the volume.
pub fn turns(data: &R2Data, config: &Config<R2Settings>) -> Vec<PictureTurn> {
    let r2 = &config.r2;
    let voxel = 2.0 / f64::from(r2.voxels);
    let room = 2.0 - voxel * f64::from(r2.tv_box);
    let turn = |step: u32, set: usize| {
        let seed = seed_of_set(config.seed, set);
        let corner = |axis: u32| -1.0 + room * uniform01(seed, STREAM_BOX, step, axis) + 0.5 * voxel;
        PictureTurn {
            corner: [0, 1, 2].map(|axis| corner(axis) as f32),
            image: data.sets.image_of_turn(set, seed, step),
        }
    };
    (0..=config.train.iterations).flat_map(|step| (0..data.n_sets()).map(move |set| turn(step, set))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;
    use crate::gaussians::view::SplatView;

    #[test]
    fn rates_fall_and_density_control_takes_no_step() {
        let config = Config::preset(Preset::R2Gaussian).of::<R2Settings>().unwrap();
        let rows = schedule(&config);
        assert_eq!(rows.len(), 30_001);
        let close = |got: f32, want: f64| assert!((f64::from(got) / want - 1.0).abs() < 1e-5, "{got} {want}");
        close(rows[29_999].position_rate, 2e-5);
        close(rows[14_999].density_rate, 1e-2 * 0.1f64.sqrt());
        assert_eq!(rows.iter().filter(|row| row.updates == 0).count(), 144);
        assert_eq!((rows[598].updates, rows[599].updates, rows[600].updates), (1, 0, 1));
        // The optimiser counts its own steps.
        close(rows[0].bias1, 0.1);
        close(rows[600].bias2, 1.0 - 0.999f64.powi(600));
        close(rows[700].bias2, 1.0 - 0.999f64.powi(699));
    }

    #[test]
    fn every_image_has_its_turn_and_boxes_stay_inside() {
        let config = Config::preset(Preset::R2Gaussian).of::<R2Settings>().unwrap();
        let view = SplatView {
            rows: [glam::DVec3::X; 3],
            offsets: [0.0; 3],
            direction: [glam::DVec3::X; 3],
            source: glam::DVec3::ZERO,
            after_phase: 0.0,
        };
        let images_of_set = vec![vec![0, 2, 4, 5], vec![1, 3, 6]];
        let data = R2Data::of_images([2, 1], vec![view; 7], vec![0.0; 14], images_of_set);
        let turns = turns(&data, &config);
        for (set, images) in (0..data.n_sets()).map(|set| (set, data.sets.images(set))) {
            let shown: Vec<usize> = turns.iter().skip(set).step_by(2).map(|turn| turn.image as usize).collect();
            let mut orders = std::collections::BTreeSet::new();
            for epoch in shown.chunks_exact(images.len()).take(100) {
                let mut sorted = epoch.to_vec();
                sorted.sort_unstable();
                assert_eq!(&sorted, images);
                orders.insert(epoch.to_vec());
            }
            let possible: usize = (1..=images.len()).product();
            assert!(2 * orders.len() > possible, "{} of {possible} orders", orders.len());
        }
        let (half_voxel, side) = (1.0 / 256.0, 32.0 / 128.0);
        for corner in turns.iter().flat_map(|turn| turn.corner).map(|x| f64::from(x) - half_voxel) {
            assert!((-1.0 - 1e-6..=1.0 - side + 1e-6).contains(&corner), "{corner}");
        }
    }
}
