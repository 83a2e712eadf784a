//! Where the network starts: at the best constant field in the hull. From a field that nearly every ray asks to be fainter, the
//! first steps throw the network below the softplus, where nothing calls it back (method, robustness of training).

use crate::config::Config;
use crate::model::hull::Hull;
use crate::plan::motion::ViewMotion;
use crate::scan::dataset::{Dataset, Frame};
use glam::DVec3;
use rayon::prelude::*;

/// Rays looked at.
const RAYS: f64 = 4000.0;
/// Depths of a ray that are looked up in the hull.
const DEPTHS: usize = 128;
/// Shifts tried, from the least on.
const LEAST_SHIFT: f64 = -8.0;
const SHIFT_STEP: f64 = 0.125;
const SHIFTS: usize = 73;
/// A constant field that leaves more than this share of what no field leaves tells nothing, as where there is no hull.
const TELLS_NOTHING: f64 = 0.99;
/// The least start then.
const LEAST_BLIND_SHIFT: f64 = -5.0;

/// What a ray asks of a constant field.
#[derive(Debug, Clone, Copy)]
struct StartRay {
    /// Length inside the hull at the phases that the ray shows, world units.
    length: f64,
    /// Bounds of its line integral.
    bounds: [f64; 2],
}

/// Rays that tell of a constant field, spread over the images evenly, those that meet the hull as often as in training.
pub struct StartRays(Vec<StartRay>);

/// What rays are made from.
struct Source<'a> {
    config: &'a Config,
    dataset: &'a Dataset,
    hull: Option<&'a Hull>,
    /// First and last depth along rays, world units.
    depth: [f64; 2],
    /// Training images, and what moves in their views.
    frames: Vec<(&'a Frame, &'a ViewMotion)>,
}

impl StartRays {
    /// Rays of a dataset's training images, by what moves in each view, as deep as the moving field goes (`depth`, world units).
    pub fn new(
        config: &Config,
        dataset: &Dataset,
        motion: &[ViewMotion],
        hull: Option<&Hull>,
        depth: [f64; 2],
    ) -> StartRays {
        let of_view = |m| dataset.training().iter().filter(|f: &&Frame| f.view == m).collect::<Vec<_>>();
        let frames = motion.iter().flat_map(|m| of_view(m.view).into_iter().map(move |f| (f, m))).collect();
        let source = Source { config, dataset, hull, depth, frames };
        let share = if hull.is_some() { config.train.motion_share } else { 0.0 };
        let mut chosen = source.spread(share * RAYS, |index, p| source.moves(index, p));
        chosen.extend(source.spread((1.0 - share) * RAYS, |index, p| source.shows(index, p)));
        StartRays(chosen.into_par_iter().map(|(index, p)| source.ray(index, p)).collect())
    }

    /// The shift inside the softplus of the constant field with the least loss with a temporal target, where a softplus of 1 is
    /// an attenuation of `gain` per world unit and residuals beyond `robust` cost linearly (0: none).
    pub fn best_shift(&self, gain: f64, robust: f64) -> f64 {
        best_shift(&self.0, gain, robust)
    }

    /// Mean loss of no field at all.
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
        let seen = if self.config.hull.per_phase { &motion.moving_at[frame.phase as usize] } else { &motion.moving };
        seen[pixel] && self.shows(index, pixel)
    }

    /// About `count` of the wanted (image, pixel), evenly. They are counted first: a list of all would be as large as the images.
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

/// About `count` of the `n` items, evenly.
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
    let shifts = (0..SHIFTS).map(|k| LEAST_SHIFT + k as f64 * SHIFT_STEP);
    let tried = shifts.map(|shift| (shift, loss(gain * shift.exp().ln_1p())));
    let best = tried.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((LEAST_SHIFT, 0.0));
    if best.1 < TELLS_NOTHING * loss(0.0) { best.0 } else { best.0.max(LEAST_BLIND_SHIFT) }
}

impl StartRay {
    /// As in training: of what is beyond the bounds.
    fn loss(&self, attenuation: f64, robust: f64) -> f64 {
        let integral = attenuation * self.length;
        // Not `clamp`, which panics where a bound is no number.
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
        assert_eq!(best_shift(&rays, 1.0, 0.1), LEAST_BLIND_SHIFT);
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
