//! First places of Gaussians, drawn from the hull's cells, and later places where data are missing.

mod likelihood;

use crate::gaussians::field::rotation_none;
use crate::gaussians::view::SplatView;
use crate::kernels::layout::Gaussian;
use crate::methods::dynamic_gaussians::rules::{GaussianRules, MISSING};
use crate::methods::dynamic_gaussians::seeds::likelihood::likelihoods;
use crate::methods::dynamic_gaussians::targets::{PossibleVessel, Targets};
use crate::random::{STREAM_JITTER, STREAM_PLACE, uniform01};
use glam::DVec3;

/// Share of the data that the first images explain: Gaussians grow into the rest. Chosen on a procedural phantom and one real anatomy.
const FIRST_SHARE: f64 = 0.7;
/// Draws `count` of the indices of `weights` without replacement, with chances in proportion to the weights; returns them in
/// ascending order.
fn draw(weights: &[f64], count: usize, seed: u32, round: u32) -> Vec<usize> {
    // Efraimidis and Spirakis: the smallest of exponential variates whose rates are the weights.
    let key = |i: usize| -(1.0 - uniform01(seed, STREAM_PLACE, round, i as u32)).ln() / weights[i];
    let mut keys: Vec<(f64, usize)> = (0..weights.len()).filter(|i| weights[*i] > 0.0).map(|i| (key(i), i)).collect();
    keys.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut drawn: Vec<usize> = keys.iter().take(count).map(|k| k.1).collect();
    drawn.sort_unstable();
    drawn
}

/// A run's random choices.
#[derive(Clone, Copy)]
struct Draw<'a> {
    targets: &'a Targets,
    settings: &'a GaussianRules,
    seed: u32,
    round: u32,
}

impl Draw<'_> {
    /// Creates `count` Gaussians of a phase and a density in places drawn by their weights.
    fn gaussians(self, weights: &[f64], count: usize, phase: usize, density: f64) -> impl Iterator<Item = Gaussian> {
        let drawn = draw(weights, count, self.seed, self.round).into_iter();
        drawn.map(move |i| Gaussian {
            position: self.position(&self.targets.places[phase][i], i as u32).as_vec3().to_array(),
            log_density: density.ln() as f32,
            log_scale: [self.settings.first_scale.ln() as f32; 3],
            phase: phase as u32,
            rotation: rotation_none(),
        })
    }

    /// Random position in the cell of a place.
    fn position(self, place: &PossibleVessel, index: u32) -> DVec3 {
        let jitter = [0, 1, 2].map(|axis| uniform01(self.seed, STREAM_JITTER, self.round, 3 * index + axis) - 0.5);
        place.position + DVec3::from_array(jitter) * self.targets.cell
    }
}

/// First Gaussians of every phase, of density 1; [`first_density`] tells the density they should have.
pub fn seeds(targets: &Targets, settings: &GaussianRules, seed: u32) -> Vec<Gaussian> {
    (0..targets.places.len()).flat_map(|phase| seeds_at(targets, settings, seed, phase)).collect()
}

/// First Gaussians of a phase; see [`seeds`].
pub fn seeds_at(targets: &Targets, settings: &GaussianRules, seed: u32, phase: usize) -> Vec<Gaussian> {
    let draw = Draw { targets, settings, seed, round: phase as u32 };
    draw.gaussians(&likelihoods(targets, phase), settings.count as usize, phase, 1.0).collect()
}

/// Density of the first Gaussians, from what they show with a density of 1: `images`, `[image][pixel]`.
pub fn first_density(targets: &Targets, images: &[f32]) -> f64 {
    let weighted = |values: &[f32], p: usize| if targets.weight[p] > 0.0 { f64::from(values[p].max(0.0)) } else { 0.0 };
    let total = |values: &[f32]| -> f64 { (0..values.len()).map(|p| weighted(values, p)).sum() };
    let (shown, wanted) = (total(images), FIRST_SHARE * total(&targets.low));
    // Without anything to show, or to explain, the density stays 1.
    if shown > 0.0 && wanted > 0.0 { wanted / shown } else { 1.0 }
}

/// Returns the number of new Gaussians of a phase.
pub fn n_additions(settings: &GaussianRules) -> usize {
    (settings.grow_share * f64::from(settings.count)) as usize
}

/// New Gaussians at places of the hull where every view lacks line integral. `images` are those of the present field,
/// `[image][pixel]`.
pub fn additions(targets: &Targets, settings: &GaussianRules, seed: u32, images: &[f32]) -> Vec<Gaussian> {
    let missing = missing_images(targets, images);
    let count = n_additions(settings);
    let mut all = Vec::new();
    for (phase, places) in targets.places.iter().enumerate() {
        let weights: Vec<f64> =
            places.iter().map(|p| enough(lacking(targets, &missing, phase, |_| p.position))).collect();
        let draw = Draw { targets, settings, seed, round: (targets.n_phases + phase) as u32 };
        all.extend(draw.gaussians(&weights, count, phase, added_density(targets)));
    }
    all
}

/// New Gaussians of a deformable set, at places of its rest phase where, moved along by `carried` (place, phase), every view lacks line
/// integral at half of the phases or more at which contrast fills it, by `is_filled` (place, phase); phases may lie between two.
pub fn deformable_additions(
    targets: &Targets,
    settings: &GaussianRules,
    seed: u32,
    images: &[f32],
    carried: impl Fn(DVec3, f64) -> DVec3,
    is_filled: impl Fn(DVec3, usize) -> bool,
) -> Vec<Gaussian> {
    let missing = missing_images(targets, images);
    let count = n_additions(settings);
    let places = &targets.places[targets.rest_phase];
    let weight = |place: &PossibleVessel| {
        let at =
            |phase: usize| lacking(targets, &missing, phase, |after| carried(place.position, phase as f64 + after));
        let filled = (0..targets.n_phases).filter(|phase| is_filled(place.position, *phase));
        let mut all: Vec<f64> = filled.map(at).collect();
        all.sort_by(f64::total_cmp);
        all.len().checked_sub(1).map_or(0.0, |last| enough(all[last / 2]))
    };
    let weights: Vec<f64> = places.iter().map(weight).collect();
    let draw = Draw { targets, settings, seed, round: targets.n_phases as u32 };
    draw.gaussians(&weights, count, targets.rest_phase, added_density(targets)).collect()
}

/// Density of a new Gaussian, whose line integral does not depend on the size of a pixel.
fn added_density(targets: &Targets) -> f64 {
    MISSING / targets.lengths.factor
}

/// Minimum line integral that the views of a phase lack at a point; `at` gives its position at a time after the phase, in
/// phases.
fn lacking(targets: &Targets, missing: &[f32], phase: usize, at: impl Fn(f64) -> DVec3) -> f64 {
    let at_phase = at(0.0);
    let of = |(image, view): (usize, &SplatView)| {
        let x = if view.after_phase == 0.0 { at_phase } else { at(view.after_phase) };
        let (_, u, v) = view.project(x);
        let (u, v) = (u.round(), v.round());
        let inside = u >= 0.0 && v >= 0.0 && u < targets.width as f64 && v < targets.height as f64;
        if inside {
            f64::from(missing[image * targets.n_pixels() + v as usize * targets.width + u as usize])
        } else {
            0.0
        }
    };
    let min = targets.views_at(phase).map(of).fold(f64::INFINITY, f64::min);
    if min.is_finite() { min } else { 0.0 }
}

/// Returns `lacking` where it is worth a Gaussian, else 0.
fn enough(lacking: f64) -> f64 {
    if lacking > MISSING { lacking } else { 0.0 }
}

/// Mean over the 3 x 3 pixels around each pixel of what the images lack; outside the image nothing is lacking.
fn missing_images(targets: &Targets, images: &[f32]) -> Vec<f32> {
    let (w, h) = (targets.width, targets.height);
    let lack = |p: usize| images[p].clamp(targets.low[p], targets.high[p]) - images[p];
    let mut out = vec![0f32; images.len()];
    for image in 0..targets.n_images {
        let first = image * w * h;
        for (y, row) in out[first..first + w * h].chunks_mut(w).enumerate() {
            for (x, mean) in row.iter_mut().enumerate() {
                let rows = y.saturating_sub(1)..(y + 2).min(h);
                let columns = x.saturating_sub(1)..(x + 2).min(w);
                let sum: f32 = rows.flat_map(|j| columns.clone().map(move |i| lack(first + j * w + i))).sum();
                *mean = (sum / 9.0).max(0.0);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_follow_the_weights_and_never_repeat() {
        let weights: Vec<f64> = (0..200).map(|i| if i < 100 { 1.0 } else { 0.05 }).collect();
        let mut heavy = 0;
        for round in 0..20 {
            let drawn = draw(&weights, 50, 3, round);
            assert_eq!(drawn.len(), 50);
            assert!(drawn.windows(2).all(|w| w[0] < w[1]), "sorted, no repeats");
            heavy += drawn.iter().filter(|i| **i < 100).count();
        }
        // About 97 % of the draws: the heavy half holds 100 of 105 parts, without replacement a little less.
        assert!((900..990).contains(&heavy), "{heavy} of 1000");
        assert_eq!(draw(&[0.0, 1.0, 0.0], 5, 1, 1), [1], "no more than there are");
    }
}
