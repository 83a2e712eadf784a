//! Start of the network: the best constant field in the hull. If nearly every ray asks for a fainter field, the first steps
//! push the network below the softplus, where no gradient brings it back (method, robustness of training).

use crate::fields::motion::ViewMotion;
use crate::model::hull::Hull;
use crate::scan::dataset::{Dataset, Frame};
use glam::DVec3;
use rayon::prelude::*;

// Numbers of this file: tried on the default phantom with right and wrong geometry, and on real anatomy.
/// Number of rays that are looked at.
const RAYS: f64 = 4000.0;
/// Depths of a ray at which the hull is looked up.
const DEPTHS: usize = 128;
/// First shift that is tried, the minimum, and the step to the next one.
const MIN_SHIFT: f64 = -8.0;
const SHIFT_STEP: f64 = 0.125;
const SHIFTS: usize = 73;
/// Share of the empty field's loss above which the best constant field tells nothing, for example without a hull.
const TELLS_NOTHING: f64 = 0.99;
/// Minimum start in that case.
const MIN_BLIND_SHIFT: f64 = -5.0;

/// Constraints of a ray on a constant field.
#[derive(Debug, Clone, Copy)]
struct StartRay {
    /// Length inside the hull at the phases that the ray shows, world units.
    length: f64,
    /// Bounds of its line integral.
    bounds: [f64; 2],
}

/// Rays that constrain a constant field, spread evenly over the images; rays that meet the hull are as frequent as in training.
pub struct StartRays(Vec<StartRay>);

/// Inputs from which the rays are made.
struct Source<'a> {
    dataset: &'a Dataset,
    hull: Option<&'a Hull>,
    /// First and last depth along rays, world units.
    depth: [f64; 2],
    /// Training images, and the motion in their views.
    frames: Vec<(&'a Frame, &'a ViewMotion)>,
}

impl StartRays {
    /// Collects rays of a dataset's training images, by the motion in each view, a share of them from rays that meet the hull, as deep as the dynamic field reaches (`depth`,
    /// world units).
    pub fn new(
        motion_share: f64,
        dataset: &Dataset,
        motion: &[ViewMotion],
        hull: Option<&Hull>,
        depth: [f64; 2],
    ) -> StartRays {
        let of_view = |m| dataset.training().iter().filter(|f: &&Frame| f.view == m).collect::<Vec<_>>();
        let frames = motion.iter().flat_map(|m| of_view(m.view).into_iter().map(move |f| (f, m))).collect();
        let source = Source { dataset, hull, depth, frames };
        let share = if hull.is_some() { motion_share } else { 0.0 };
        let mut chosen = source.spread(share * RAYS, |index, p| source.moves(index, p));
        chosen.extend(source.spread((1.0 - share) * RAYS, |index, p| source.shows(index, p)));
        StartRays(chosen.into_par_iter().map(|(index, p)| source.ray(index, p)).collect())
    }

    /// Returns the shift inside the softplus of the constant field with the minimum loss with a temporal target, where a
    /// softplus of 1 is an attenuation of `gain` per world unit and residuals beyond `robust` cost linearly (0: none).
    pub fn best_shift(&self, gain: f64, robust: f64) -> f64 {
        best_shift(&self.0, gain, robust)
    }

    /// Mean loss of an empty field.
    pub fn empty_loss(&self, robust: f64) -> f64 {
        self.0.iter().map(|ray| ray.loss(0.0, robust)).sum::<f64>() / self.0.len().max(1) as f64
    }
}

impl Source<'_> {
    fn shows(&self, index: usize, pixel: usize) -> bool {
        self.dataset.shows(self.frames[index].0.view, pixel)
    }

    fn moves(&self, index: usize, pixel: usize) -> bool {
        let (frame, motion) = self.frames[index];
        let seen = &motion.moving_at[frame.phase as usize];
        seen[pixel] && self.shows(index, pixel)
    }

    /// Picks about `count` of the wanted (image, pixel), evenly. They are counted first: a list of all would be as large as the
    /// images.
    fn spread(&self, count: f64, wanted: impl Fn(usize, usize) -> bool) -> Vec<(usize, usize)> {
        let pixels = self.dataset.n_pixels();
        let all = || (0..self.frames.len()).flat_map(|index| (0..pixels).map(move |p| (index, p)));
        let every = || all().filter(|(index, p)| wanted(*index, *p));
        spread(every().count(), count, every())
    }

    fn ray(&self, index: usize, pixel: usize) -> StartRay {
        let (frame, motion) = self.frames[index];
        let (column, row) = (pixel % self.dataset.width, pixel / self.dataset.width);
        let (anchor, direction) = self.dataset.views[frame.view].rays.pixel(column as f64, row as f64);
        let [near, far] = self.depth;
        let step = (far - near) / DEPTHS as f64;
        let shown = frame.beat_time().shown(self.dataset.n_phases);
        let searched =
            |hull: &Hull, point| shown.iter().any(|(t, share)| *share > 0.0 && hull.contains_point(point, *t));
        let inside = |point: DVec3| self.hull.is_none_or(|hull| searched(hull, point));
        let met = (0..DEPTHS).filter(|k| inside(anchor + direction * (near + (*k as f64 + 0.5) * step))).count();
        let target = f64::from(frame.integrals[pixel]);
        StartRay {
            length: met as f64 * step * direction.length(),
            bounds: [motion.background[pixel], motion.background_low[pixel]].map(|b| target - f64::from(b)),
        }
    }
}

/// Picks about `count` of the `n` items, evenly.
fn spread<T>(n: usize, count: f64, items: impl Iterator<Item = T>) -> Vec<T> {
    if count < 1.0 {
        return Vec::new();
    }
    let step = (n as f64 / count).max(1.0);
    let mut taken = 0;
    let wanted = |(k, _): &(usize, T)| {
        let take = *k == (taken as f64 * step) as usize;
        taken += usize::from(take);
        take
    };
    items.enumerate().filter(wanted).map(|(_, item)| item).collect()
}

fn best_shift(rays: &[StartRay], gain: f64, robust: f64) -> f64 {
    let loss = |attenuation: f64| -> f64 { rays.iter().map(|ray| ray.loss(attenuation, robust)).sum() };
    let shifts = (0..SHIFTS).map(|k| MIN_SHIFT + k as f64 * SHIFT_STEP);
    let tried = shifts.map(|shift| (shift, loss(gain * shift.exp().ln_1p())));
    let best = tried.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((MIN_SHIFT, 0.0));
    if best.1 < TELLS_NOTHING * loss(0.0) { best.0 } else { best.0.max(MIN_BLIND_SHIFT) }
}

impl StartRay {
    /// Loss as in training: the part of the line integral beyond the bounds counts.
    fn loss(&self, attenuation: f64, robust: f64) -> f64 {
        let integral = attenuation * self.length;
        // `clamp` would panic where a bound is not a number.
        let residual = integral - integral.max(self.bounds[0]).min(self.bounds[1]);
        if robust == 0.0 {
            return residual * residual;
        }
        2.0 * robust * robust * ((1.0 + (residual / robust).powi(2)).sqrt() - 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ray(length: f64, integral: f64) -> StartRay {
        StartRay { length, bounds: [integral; 2] }
    }

    #[test]
    fn a_constant_field_that_explains_all_rays_is_found() {
        let attenuation = |shift: f64| 3.0 * shift.exp().ln_1p();
        for shift in [-4.0, -0.75, 0.5] {
            let rays: Vec<_> = (1..50).map(|k| 0.1 * f64::from(k)).map(|l| ray(l, l * attenuation(shift))).collect();
            assert_eq!(best_shift(&rays, 3.0, 0.0), shift);
            assert_eq!(best_shift(&rays, 3.0, 0.2), shift);
        }
    }

    #[test]
    fn deep_fields_of_which_rays_see_little_start_lower() {
        let half =
            |length: f64| -> Vec<_> { (0..100).map(|k| ray(length, if k % 2 == 0 { 1.0 } else { 0.0 })).collect() };
        assert!(best_shift(&half(4.0), 1.0, 0.0) < best_shift(&half(1.0), 1.0, 0.0));
    }

    #[test]
    fn where_no_constant_field_helps_the_start_is_not_nothing() {
        let rays: Vec<_> = (0..1000).map(|k| ray(4.0, if k == 0 { 1.0 } else { 0.0 })).collect();
        assert_eq!(best_shift(&rays, 1.0, 0.1), MIN_BLIND_SHIFT);
        assert!(best_shift(&[], 1.0, 0.1).is_finite());
    }

    #[test]
    fn items_are_taken_evenly() {
        assert_eq!(spread(10, 5.0, 0..10), [0, 2, 4, 6, 8]);
        assert_eq!(spread(10, 4.0, 0..10), [0, 2, 5, 7]);
        assert_eq!(spread(3, 5.0, 0..3), [0, 1, 2]);
        assert!(spread(3, 0.0, 0..3).is_empty());
    }
}
