//! Where Gaussians begin: drawn from the hull's cells, and later where data are missing.

use super::layout::{Gaussian, GaussianSetup};
use super::model::rotation_none;
use super::reference::{params, project};
use super::scene::{Place, Scene};
use super::settings::Settings;
use super::view::SplatView;
use crate::cpu::random::{normal, uniform01};
use glam::DVec3;

/// Which places are drawn.
const STREAM_PLACE: u32 = 32;
/// Where in a cell a Gaussian begins.
const STREAM_JITTER: u32 = 33;
/// Share of the data that the first images explain: Gaussians grow into the rest.
const FIRST_SHARE: f64 = 0.7;
/// Evidence of four views at which half the cells hold vessel, and how fast that share rises.
const LIKELY_EVIDENCE: f64 = 14.0;
const EVIDENCE_WIDTH: f64 = 1.5;

/// Chance that a cell of the hull holds vessel, as measured on phantoms.
fn likelihood(evidence: f64, n_views: usize) -> f64 {
    let likely = LIKELY_EVIDENCE / 4.0 * n_views.max(4) as f64;
    1.0 / (1.0 + (-(evidence - likely) / EVIDENCE_WIDTH).exp())
}

/// `count` of the indices of `weights`, drawn without replacement with chances in proportion to the weights; by
/// ascending index.
fn draw(weights: &[f64], count: usize, seed: u32, round: u32) -> Vec<usize> {
    // Efraimidis and Spirakis: the smallest of exponential variates whose rates are the weights.
    let key = |i: usize| -(1.0 - uniform01(seed, STREAM_PLACE, round, i as u32)).ln() / weights[i];
    let mut keys: Vec<(f64, usize)> = (0..weights.len()).filter(|i| weights[*i] > 0.0).map(|i| (key(i), i)).collect();
    keys.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let mut drawn: Vec<usize> = keys.iter().take(count).map(|k| k.1).collect();
    drawn.sort_unstable();
    drawn
}

fn gaussian(scene: &Scene, settings: &Settings, place: &Place, phase: usize, density: f64, key: [u32; 2]) -> Gaussian {
    let [round, index] = key;
    let jitter = [0, 1, 2].map(|axis| uniform01(settings.seed, STREAM_JITTER + axis, round, index) - 0.5);
    let position = place.position + DVec3::from_array(jitter) * scene.cell;
    Gaussian {
        position: position.as_vec3().to_array(),
        log_density: density.ln() as f32,
        log_scale: [settings.first_scale.ln() as f32; 3],
        phase: phase as u32,
        rotation: rotation_none(),
    }
}

/// The first Gaussians of every phase.
pub fn seeds(scene: &Scene, settings: &Settings, setup: &GaussianSetup) -> Vec<Gaussian> {
    let mut all = Vec::new();
    for (phase, places) in scene.places.iter().enumerate() {
        let n_views = scene.views_at(phase).count();
        let weights: Vec<f64> = places.iter().map(|p| likelihood(p.evidence, n_views)).collect();
        for i in draw(&weights, settings.count as usize, settings.seed, phase as u32) {
            all.push(gaussian(scene, settings, &places[i], phase, 1.0, [phase as u32, i as u32]));
        }
    }
    let shown = total_of_images(scene, setup, &all);
    let wanted: f64 = FIRST_SHARE * scene.low.iter().map(|v| f64::from(v.max(0.0))).sum::<f64>();
    if shown > 0.0 && wanted > 0.0 {
        let density = (wanted / shown).ln() as f32;
        all.iter_mut().for_each(|g| g.log_density = density);
    }
    all
}

/// Sum of all pixels of the images of Gaussians, from their integrals over the plane.
fn total_of_images(scene: &Scene, setup: &GaussianSetup, gaussians: &[Gaussian]) -> f64 {
    let in_image = |g: &Gaussian| -> f64 {
        let seen = scene.views_at(g.phase as usize).filter_map(|(_, view)| project(&params(g), view, setup));
        let inside = seen
            .filter(|p| p.mean.min_element() >= 0.0 && p.mean.x < scene.width as f64 && p.mean.y < scene.height as f64);
        inside.map(|p| p.amplitude * std::f64::consts::TAU / p.conic.determinant().sqrt()).sum()
    };
    gaussians.iter().map(in_image).sum()
}

/// New Gaussians at places of the hull where every view lacks line integral. `images` are those of the present field,
/// `[image][pixel]`.
pub fn additions(scene: &Scene, settings: &Settings, images: &[f32], round: u32) -> Vec<Gaussian> {
    let missing = missing_images(scene, images);
    let count = (settings.grow_share * f64::from(settings.count)) as usize;
    let mut all = Vec::new();
    for (phase, places) in scene.places.iter().enumerate() {
        let key = round * scene.n_phases as u32 + phase as u32;
        let weights: Vec<f64> =
            places.iter().map(|p| enough(settings, lacking(scene, &missing, phase, p.position))).collect();
        for i in draw(&weights, count, settings.seed, key) {
            all.push(gaussian(scene, settings, &places[i], phase, settings.missing, [key, i as u32]));
        }
    }
    all
}

/// New Gaussians of a tree at places of phase 0 where, carried along by `carried` (place, phase), every view lacks line
/// integral at half the phases or more.
pub fn tree_additions(
    scene: &Scene,
    settings: &Settings,
    images: &[f32],
    round: u32,
    carried: impl Fn(DVec3, usize) -> DVec3,
) -> Vec<Gaussian> {
    let missing = missing_images(scene, images);
    let count = (settings.grow_share * f64::from(settings.count)) as usize;
    let places = &scene.places[0];
    let weight = |place: &Place| {
        let at = |phase: usize| lacking(scene, &missing, phase, carried(place.position, phase));
        let mut all: Vec<f64> = (0..scene.n_phases).map(at).collect();
        all.sort_by(f64::total_cmp);
        enough(settings, all[(all.len() - 1) / 2])
    };
    let weights: Vec<f64> = places.iter().map(weight).collect();
    let key = round * scene.n_phases as u32;
    let drawn = draw(&weights, count, settings.seed, key).into_iter();
    drawn.map(|i| gaussian(scene, settings, &places[i], 0, settings.missing, [key, i as u32])).collect()
}

/// Least line integral that the views of a phase lack at a point.
fn lacking(scene: &Scene, missing: &[f32], phase: usize, x: DVec3) -> f64 {
    let of = |(image, view): (usize, &SplatView)| {
        let (_, u, v) = view.project(x);
        let (u, v) = (u.round(), v.round());
        let inside = u >= 0.0 && v >= 0.0 && u < scene.width as f64 && v < scene.height as f64;
        if inside { f64::from(missing[image * scene.n_pixels() + v as usize * scene.width + u as usize]) } else { 0.0 }
    };
    let least = scene.views_at(phase).map(of).fold(f64::INFINITY, f64::min);
    if least.is_finite() { least } else { 0.0 }
}

/// What is lacking, where it is worth a Gaussian.
fn enough(settings: &Settings, lacking: f64) -> f64 {
    if lacking > settings.missing { lacking } else { 0.0 }
}

/// Mean of the 3 x 3 pixels around each of what the images lack; outside, nothing is lacking.
fn missing_images(scene: &Scene, images: &[f32]) -> Vec<f32> {
    let (w, h) = (scene.width, scene.height);
    let lack = |p: usize| images[p].clamp(scene.low[p], scene.high[p]) - images[p];
    let mut out = vec![0f32; images.len()];
    for image in 0..scene.n_images {
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

/// Gaussians of all shapes, for tests: within `reach` pixels of the isocentre.
#[doc(hidden)]
pub fn random_gaussians(n: usize, n_phases: u32, reach: f64, seed: u32) -> Vec<Gaussian> {
    let value = |i: usize, k: u32| normal(seed, STREAM_JITTER, i as u32, k);
    (0..n)
        .map(|i| Gaussian {
            position: [0, 1, 2].map(|k| (0.5 * reach * value(i, k)) as f32),
            log_density: (-1.5 + 0.4 * value(i, 3)) as f32,
            log_scale: [4, 5, 6].map(|k| (0.3 * value(i, k)) as f32),
            phase: i as u32 % n_phases,
            rotation: [7, 8, 9, 10].map(|k| value(i, k) as f32),
        })
        .collect()
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
