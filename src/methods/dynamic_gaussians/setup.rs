//! Constants and schedule of a fit of Gaussians.

use crate::config::sections::Rule;
use crate::fitting::RING_LENGTH;
use crate::gaussians::field::inverse_step;
use crate::gaussians::stages::{FIXED_POINT_BITS, loss_parts};
use crate::kernels::layout::{GaussianSchedule, GaussianSetup, MotionGridSetup};
use crate::methods::dynamic_gaussians::rules::{
    BEND, DENSITY_RATE, DeformableRules, FALL_SHARE, GaussianRules, HARMONICS, LAST_RATE, ROTATION_RATE, SCALE_RATE,
};
use crate::methods::dynamic_gaussians::targets::Targets;

/// Decay of Adam's first and second moments, and its smallest denominator. The decay was chosen on a procedural phantom and one real
/// anatomy.
const BETAS: [f32; 2] = [0.9, 0.98];
const EPSILON: f32 = 1e-12;
/// Decay of Adam's moments while a phase is tracked: little memory, for few iterations.
const TRACK_BETAS: [f32; 2] = [0.8, 0.95];
/// Share of the rate that is left at the end of a tracked phase; the rate falls to it linearly. Chosen on a procedural phantom and one
/// real anatomy.
const TRACK_LAST_RATE: f64 = 0.2;
/// Margin of the grid beyond the hull, pixels.
const MARGIN: f64 = 2.0;

/// Constants of a fit.
pub fn gaussian_setup(targets: &Targets, settings: &GaussianRules) -> GaussianSetup {
    let image_stride = (targets.n_pixels() as u32).next_multiple_of(4);
    GaussianSetup {
        n_views: targets.n_views as u32,
        n_phases: targets.n_phases as u32,
        width: targets.width as u32,
        height: targets.height as u32,
        cut: settings.cut as f32,
        min_scale: settings.min_scale as f32,
        max_scale: settings.max_scale as f32,
        fixed_point: 2f32.powi(FIXED_POINT_BITS),
        bend: BEND as f32,
        loss_weight: 1.0 / targets.phases_seen().max(1) as f32,
        beta1: BETAS[0],
        beta2: BETAS[1],
        epsilon: EPSILON,
        position_rate: settings.position_rate as f32,
        scale_rate: SCALE_RATE as f32,
        rotation_rate: ROTATION_RATE as f32,
        density_rate: DENSITY_RATE as f32,
        ring_length: RING_LENGTH,
        n_images: targets.n_images as u32,
        image_stride,
        n_loss_parts: loss_parts(targets.n_images as u32 * image_stride / 4),
        blur: 0.0,
    }
}

/// Constants while the motion of a deformable set is tracked, a phase at a time.
pub fn track_setup(setup: &GaussianSetup, settings: &DeformableRules) -> GaussianSetup {
    GaussianSetup {
        blur: settings.track_blur as f32,
        loss_weight: 1.0,
        beta1: TRACK_BETAS[0],
        beta2: TRACK_BETAS[1],
        n_loss_parts: loss_parts(setup.n_views * setup.image_stride / 4),
        ..*setup
    }
}

/// Constants of a deformable set's grid, which encloses the hull.
pub fn deformable_setup(targets: &Targets, settings: &DeformableRules) -> MotionGridSetup {
    let reach = targets.places.iter().flatten().map(|p| p.position.abs().max_element()).fold(0.0, f64::max);
    let half_side = reach + MARGIN;
    let n_nodes = (2.0 * half_side / settings.node).ceil() as u32 + 1;
    // Harmonics beyond half the number of phases cannot be told apart.
    let harmonics = HARMONICS.min((targets.n_phases as u32).saturating_sub(1) / 2);
    MotionGridSetup {
        n_nodes,
        half_side: half_side as f32,
        inverse_step: inverse_step(n_nodes, half_side as f32),
        n_basis: 2 * harmonics,
        smoothness: (settings.smoothness / targets.n_phases as f64) as f32,
        own_penalty: settings.own_penalty as f32,
        grid_rate: settings.grid_rate as f32,
        own_rate: settings.own_rate as f32,
        rest_phase: targets.rest_phase as u32,
    }
}

/// One row per iteration.
pub fn schedule(settings: &GaussianRules) -> Vec<GaussianSchedule> {
    (0..settings.iterations.max(1)).map(|step| row(step, rate(settings, step), BETAS)).collect()
}

/// One row per iteration of a tracked phase.
pub fn track_schedule(settings: &DeformableRules) -> Vec<GaussianSchedule> {
    let n = settings.track_iterations.max(1);
    let rate = |step: u32| 1.0 - (1.0 - TRACK_LAST_RATE) * f64::from(step) / f64::from(n);
    (0..n).map(|step| row(step, rate(step), TRACK_BETAS)).collect()
}

fn row(step: u32, rate: f64, betas: [f32; 2]) -> GaussianSchedule {
    let bias = |beta: f32| (1.0 - f64::from(beta).powi(step as i32 + 1)) as f32;
    GaussianSchedule { rate: rate as f32, bias1: bias(betas[0]), bias2: bias(betas[1]) }
}

/// Tells whether Gaussians are dropped and placed before an iteration.
pub fn grows(settings: &GaussianRules, step: u32) -> bool {
    settings.grow_at > 0 && step == settings.grow_at
}

/// Tells whether Gaussians too faint for vessels are dropped before an iteration.
pub fn clears(settings: &GaussianRules, step: u32) -> bool {
    settings.clear_at > 0 && step == settings.clear_at && settings.left_out.keeps(Rule::FaintGaussians)
}

/// Tells whether Gaussians that stand for no vessel are dropped after an iteration.
pub fn parts_from_strays(settings: &GaussianRules, step: u32) -> bool {
    settings.link > 0.0 && step == settings.iterations && settings.left_out.keeps(Rule::IsolatedGaussians)
}

/// Tells whether the static background is estimated anew before an iteration. It is not while rates fall, since the fit could
/// hardly follow.
pub fn renews_background(settings: &GaussianRules, step: u32) -> bool {
    let every = settings.background_every;
    every > 0 && step > 0 && step.is_multiple_of(every) && rate(settings, step) == 1.0
}

/// Returns the iteration from which a fit goes on that is carried over to other data: the first one before which the background
/// is estimated anew.
pub fn carried_step(settings: &GaussianRules) -> u32 {
    (1..settings.iterations).find(|step| renews_background(settings, *step)).unwrap_or(0)
}

/// Returns the iteration from which a fit that began on coarser images goes on with all pixels: the last one before which the background
/// is estimated anew; none without any.
pub fn fine_step(settings: &GaussianRules) -> Option<u32> {
    (1..settings.iterations).rev().find(|step| renews_background(settings, *step))
}

/// Returns where iterations from `step` on towards `until` must stop, because something must be done before the next one.
pub fn next_stop(settings: &GaussianRules, step: u32, until: u32) -> u32 {
    (step + 1..until)
        .find(|s| grows(settings, *s) || clears(settings, *s) || renews_background(settings, *s))
        .unwrap_or(until)
}

/// Factor on all rates at an iteration: 1, falling linearly at the end.
fn rate(settings: &GaussianRules, step: u32) -> f64 {
    let left = f64::from(settings.iterations.saturating_sub(step));
    (left / (FALL_SHARE * f64::from(settings.iterations.max(1)))).clamp(LAST_RATE, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::dynamic_gaussians::targets::test_targets::rules;

    #[test]
    fn rates_fall_over_the_last_third() {
        let rate = |step| rate(&rules().gaussians, step);
        assert_eq!((rate(0), rate(84)), (1.0, 1.0));
        assert!((rate(102) - 0.5).abs() < 1e-12 && (rate(119) - 0.05).abs() < 1e-12);
    }
    #[test]
    fn iterations_stop_where_something_is_to_be_done() {
        let settings = rules().gaussians;
        let stops = std::iter::successors(Some(0), |s| (*s < 120).then(|| next_stop(&settings, *s, 120)));
        assert_eq!(stops.collect::<Vec<_>>(), [0, 40, 50, 65, 80, 120]);
        assert_eq!((carried_step(&settings), fine_step(&settings)), (40, Some(80)));
        assert!(renews_background(&settings, 40) && !renews_background(&settings, 0) && grows(&settings, 50));
        let never = GaussianRules { background_every: 0, grow_at: 0, clear_at: 0, ..settings };
        assert_eq!((next_stop(&never, 3, 70), renews_background(&never, 40), carried_step(&never)), (70, false, 0));
        assert_eq!(fine_step(&never), None);
    }
}
