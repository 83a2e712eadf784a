//! What moves in the angiograms, found without segmentation: each view's still background, its noise,
//! and the motion hull, the set of points whose projection changes over time in every view that sees them.

use crate::config;
use crate::raster::{Image, dilate, median, opening, percentile};
use crate::scan::dataset::Dataset;
use rayon::prelude::*;

/// Temporal behaviour of one training view.
#[derive(Debug, Clone)]
pub struct ViewMotion {
    /// Index into [`Dataset::views`].
    pub view: usize,
    /// Upper bound of the still background: each pixel's smallest line integral over the phases, corrected for
    /// the bias that taking a minimum of noisy values has.
    pub background: Vec<f32>,
    /// Lower bound of the still background: what remains of it without structures as thin as vessels, since a
    /// vessel that covers a pixel at every phase is part of the minimum.
    pub background_low: Vec<f32>,
    /// Largest integral above the background over the phases.
    pub range: Vec<f32>,
    /// Standard deviation of a pixel's noise.
    pub noise: Vec<f32>,
    /// Pixels that move at some phase.
    pub moving: Vec<bool>,
    /// Pixels that stand out of the background at each phase of the dataset; empty for phases not seen.
    pub moving_at: Vec<Vec<bool>>,
    /// Training phases of this view.
    pub n_phases: usize,
}

/// How far the smallest of `n` standard normal draws lies below the mean, on average.
pub(super) fn expected_minimum(n: usize) -> f64 {
    // Blom's approximation of the first normal order statistic.
    if n < 2 {
        return 0.0;
    }
    let p = (1.0 - 0.375) / (n as f64 + 0.25);
    // Inverse of the normal tail by bisection.
    let (mut low, mut high) = (0.0, 8.0);
    for _ in 0..60 {
        let mid = 0.5 * (low + high);
        if upper_tail(mid) > p { low = mid } else { high = mid }
    }
    0.5 * (low + high)
}

/// P(X > z) of a standard normal (Abramowitz and Stegun 26.2.17, error below 7.5e-8).
fn upper_tail(z: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.231_641_9 * z);
    let poly =
        t * (0.319_381_530 + t * (-0.356_563_782 + t * (1.781_477_937 + t * (-1.821_255_978 + t * 1.330_274_429))));
    (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt() * poly
}

/// Noise of each pixel: successive phases of a still pixel differ by noise alone, and noise depends on
/// intensity; so pixels are grouped by intensity and each group's median temporal deviation is its noise. A group that
/// consists of moving vessels, as the darkest of an image with a plain background does, would pass them off as noise;
/// so none is noisier than a few times the image as a whole.
pub(super) fn noise_by_intensity(mean: &[f32], deviation: &[f32]) -> Vec<f32> {
    const GROUPS: usize = 24;
    const NOISIEST: f32 = 6.0;
    let most = NOISIEST * median(&mut deviation.to_vec());
    let mut order: Vec<u32> = (0..mean.len() as u32).collect();
    order.sort_unstable_by(|a, b| mean[*a as usize].total_cmp(&mean[*b as usize]));
    let mut noise = vec![0.0; mean.len()];
    for group in order.chunks(mean.len().div_ceil(GROUPS)) {
        let level = median(&mut group.iter().map(|i| deviation[*i as usize]).collect::<Vec<_>>());
        for i in group {
            noise[*i as usize] = level.min(most);
        }
    }
    noise
}

/// Analyses each training view.
pub fn analyse(dataset: &Dataset, config: &config::sections::Hull) -> Vec<ViewMotion> {
    let views = dataset.training_views();
    let min_share = if views.len() < 4 { config.min_share_few_views } else { config.min_share } as f32;
    views
        .into_par_iter()
        .map(|view| {
            let mut frames: Vec<_> = dataset.training().iter().filter(|f| f.view == view).collect();
            frames.sort_by_key(|f| f.phase);
            let n = frames.len();
            let pixels = dataset.n_pixels();
            let at = |p: usize| frames.iter().map(move |f| f.integrals[p]);
            let mean: Vec<f32> = (0..pixels).map(|p| at(p).sum::<f32>() / n as f32).collect();
            // Successive differences over sqrt 2: slow change over the beat counts little.
            let deviation: Vec<f32> = (0..pixels)
                .map(|p| {
                    let mut steps: Vec<f32> =
                        frames.windows(2).map(|w| (w[1].integrals[p] - w[0].integrals[p]).abs()).collect();
                    median(&mut steps) * (1.4826 / std::f32::consts::SQRT_2)
                })
                .collect();
            let noise = noise_by_intensity(&mean, &deviation);
            let bias = expected_minimum(n) as f32;
            let lowest: Vec<f32> = (0..pixels).map(|p| at(p).fold(f32::INFINITY, f32::min)).collect();
            let highest: Vec<f32> = (0..pixels).map(|p| at(p).fold(f32::NEG_INFINITY, f32::max)).collect();
            let background: Vec<f32> =
                lowest.iter().zip(&noise).map(|(l, s)| if n > 1 { l + bias * s } else { 0.0 }).collect();
            let image = |values: Vec<f32>| Image { width: dataset.width, height: dataset.height, values };
            let vessel = config.vessel_pixels as usize;
            let background_low = if vessel > 0 && n > 1 {
                opening(&image(background.clone()), vessel).values
            } else {
                background.clone()
            };
            let range: Vec<f32> = highest.iter().zip(&background).map(|(h, b)| (h - b).max(0.0)).collect();
            let strongest = percentile(&range, 0.995);
            let threshold = |p: usize| (config.noise_sigmas as f32 * noise[p]).max(min_share * strongest);
            let grow = |marked: &dyn Fn(usize) -> bool| -> Vec<bool> {
                let marked = (0..pixels).map(|p| f32::from(u8::from(n > 1 && marked(p))));
                let grown = dilate(&image(marked.collect()), config.dilate_pixels as usize);
                grown.values.iter().map(|v| *v > 0.0).collect()
            };
            let mut moving_at = vec![Vec::new(); dataset.n_phases as usize];
            for frame in &frames {
                let stands_out = |p: usize| frame.integrals[p] - background_low[p] > threshold(p);
                moving_at[frame.phase as usize] = grow(&|p| range[p] > threshold(p) && stands_out(p));
            }
            let moving = grow(&|p| range[p] > threshold(p));
            ViewMotion { view, moving, moving_at, background, background_low, range, noise, n_phases: n }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn expected_minimum_of_ten_normals() {
        assert!((expected_minimum(10) - 1.5388).abs() < 0.01, "{}", expected_minimum(10));
        assert_eq!(expected_minimum(1), 0.0);
    }

    #[test]
    fn moving_vessels_are_not_taken_for_noise() {
        // The brightest tenth moves; all else is still but for noise of 0.01.
        let mean: Vec<f32> = (0..1000).map(|i| i as f32).collect();
        let deviation: Vec<f32> = (0..1000).map(|i| if i >= 900 { 0.5 } else { 0.01 }).collect();
        let noise = noise_by_intensity(&mean, &deviation);
        assert!((noise[0] - 0.01).abs() < 1e-6 && noise[999] <= 0.06 + 1e-6, "{}", noise[999]);
    }
}
