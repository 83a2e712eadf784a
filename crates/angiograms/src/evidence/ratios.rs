//! Evidence of a view for and against a vessel at each pixel and phase: log-likelihood ratios of "a vessel is here".
//!
//! The steps are: background, change above it, the smallest filter with low enough noise for the weakest vessel, ratio.
//! Ratios are clipped, so that no single view can reject or confirm a cell.

use crate::evidence::background::{Background, largest_within};
use crate::evidence::filters::{Estimate, LineFilter, blob, map2};
use crate::evidence::series::Series;
use crate::raster::Image;
use crate::scan::canvas::continued;
use rayon::prelude::*;

// Numbers of this file without another source: chosen by the share of the vessels' cells that the soft hull keeps, on a procedural
// phantom and one real anatomy with several levels of noise.
/// Amplitude of the weakest vessel sought, as a share of the view's strongest change.
const MIN_SHARE_OF_STRONGEST: f32 = 0.08;
/// The noise of a filter is low enough when it is at most the weakest vessel divided by this.
const QUIET_ENOUGH: f32 = 1.5;
/// Gaussians of the ladder of filters, standard deviations in pixels.
const BLOBS: [f32; 2] = [0.6, 0.9];
/// Lines of the ladder of filters: length and width (standard deviation), pixels.
const LINES: [(f32, f32); 3] = [(5.0, 0.9), (9.0, 1.0), (13.0, 1.2)];
/// Pixels are limited to this many standard deviations before line filters, so that strong vessels do not leak sideways.
const LINE_CEILING: f32 = 3.0;
/// Mean excess of the best orientation over zero in pure noise, standard deviations.
const LINE_BIAS: f32 = 1.2;
/// Maximum change in standard deviations that line filters can show, as [`LINE_CEILING`] limits it.
const LINE_MOST: f32 = 0.6 * LINE_CEILING;
/// Beside a vessel, the minimum amplitude is this share of it.
const LEAK: f32 = 0.25;
/// Reach of the leakage of vessels, pixels.
const LEAK_PIXELS: usize = 2;
/// Blur before the search for leakage, and of covered pixels in noise, pixels.
const NEAR_BLUR: f32 = 0.7;
/// Maximum evidence of a view for a cell: minus the natural logarithm of the share of pixels that vessels cover.
pub const MOST: f32 = 3.0;
/// Minimum evidence of a view, against a cell: the natural logarithm of the probability (9 %) that the view hides an existing vessel.
pub const LEAST: f32 = -2.4;
/// Evidence (natural logarithm) subtracted where only the opened background shows the vessel.
const COVERED_COST: f32 = 0.5;
/// Number of amplitudes between the weakest and the strongest vessel.
const AMPLITUDES: usize = 8;

/// Evidence of one view.
#[derive(Debug, Clone)]
pub struct ViewEvidence {
    /// Index into the dataset's views.
    pub view: usize,
    /// The view's static background.
    pub background: Background,
    /// Log-likelihood ratio per pixel, one image per phase; `None` where the view has no image.
    pub ratios: Vec<Option<Image>>,
}

impl ViewEvidence {
    /// Analyses a view.
    pub fn new(series: &Series) -> ViewEvidence {
        ViewEvidence::of(series.clone())
    }

    /// Analyses a view, whose images are taken over.
    pub fn of(series: Series) -> ViewEvidence {
        let view = series.view;
        let background = Background::new(series);
        let ladder = Ladder::new(&background);
        let seen: Vec<Option<Phase>> =
            background.changes.par_iter().map(|change| change.as_ref().map(|change| ladder.phase(change))).collect();
        let filtered = seen.iter().flatten().any(|p| p.filtered);
        let largest = largest_ratio(seen.iter().flatten().map(|p| &p.ratio));
        let ratios = background
            .stilled
            .images
            .par_iter()
            .zip(&seen)
            .map(|(image, phase)| {
                let (image, phase) = (image.as_ref()?, phase.as_ref()?);
                Some(ladder.with_covered_pixels(image, phase, &largest, filtered))
            })
            .collect();
        ViewEvidence { view, background, ratios }
    }

    /// Places the evidence in the corner of a canvas (columns, rows), and continues its edges there.
    pub fn on_canvas(self, canvas: [usize; 2]) -> ViewEvidence {
        ViewEvidence {
            background: self.background.on_canvas(canvas),
            ratios: self.ratios.into_iter().map(|ratio| Some(continued(ratio?, canvas))).collect(),
            ..self
        }
    }
}

fn largest_ratio<'a>(ratios: impl Iterator<Item = &'a Image>) -> Vec<f32> {
    let mut largest: Vec<f32> = Vec::new();
    for ratio in ratios {
        if largest.is_empty() {
            largest.clone_from(&ratio.values);
        }
        largest.iter_mut().zip(&ratio.values).for_each(|(max, v)| *max = max.max(*v));
    }
    largest
}

/// Evidence of one phase against the background.
struct Phase {
    ratio: Image,
    /// Minimum amplitude of a vessel at each pixel.
    weakest: Image,
    /// At least one pixel was too noisy to be used unfiltered.
    filtered: bool,
}

/// The filters of a view, with the quantities derived from its noise.
struct Ladder<'a> {
    background: &'a Background,
    weakest: f32,
    /// Inverse variance.
    weight: Image,
    lines: Vec<(LineFilter, Vec<Image>)>,
}

impl<'a> Ladder<'a> {
    fn new(background: &'a Background) -> Ladder<'a> {
        let noise = &background.noise;
        let weight = Image { values: noise.values.iter().map(|s| 1.0 / (s * s)).collect(), ..noise.clone() };
        let weakest = MIN_SHARE_OF_STRONGEST * background.strongest;
        let quiet = weakest / QUIET_ENOUGH;
        // The noise of Gaussians does not depend on the image, so it is known at this point whether any pixel needs a line
        // filter.
        let widest = blob(noise, &weight, BLOBS[BLOBS.len() - 1]).deviation;
        let needed = widest.values.iter().any(|tau| *tau > quiet);
        let line = |(length, width): (f32, f32)| {
            let filter = LineFilter::new(length, width);
            let energies = filter.energies(&weight);
            (filter, energies)
        };
        let lines = if needed { LINES.map(line).into() } else { Vec::new() };
        Ladder { background, weakest, weight, lines }
    }

    /// Applies larger and larger filters until the noise of every pixel is low enough, or the ladder ends.
    fn phase(&self, change: &Image) -> Phase {
        let noise = &self.background.noise;
        let quiet = self.weakest / QUIET_ENOUGH;
        let mut best = Estimate { amplitude: change.clone(), deviation: noise.clone() };
        let mut by_line = vec![false; change.values.len()];
        let filtered = noise.values.iter().any(|s| *s > quiet);
        for sigma in BLOBS {
            self.climb(&mut best, quiet, |_| blob(change, &self.weight, sigma), |_| ());
        }
        if !self.lines.is_empty() {
            let capped = map2(change, noise, |d, s| d.min(LINE_CEILING * s));
            let weighted = map2(&capped, &self.weight, |d, w| d * w);
            for (filter, energies) in &self.lines {
                let climb = |rows: &[bool]| filter.best(&weighted, energies, LINE_BIAS, rows);
                self.climb(&mut best, quiet, climb, |p| by_line[p] = true);
            }
        }
        let weakest = self.weakest_beside(change, &by_line);
        let ratio = self.ratio(&best, &weakest);
        Phase { ratio, weakest, filtered }
    }

    /// Replaces the pixels that are too noisy by the output of `filter`, which receives the rows that are needed.
    fn climb(&self, best: &mut Estimate, quiet: f32, filter: impl Fn(&[bool]) -> Estimate, mut at: impl FnMut(usize)) {
        let width = best.deviation.width;
        let noisy: Vec<bool> = best.deviation.values.iter().map(|tau| *tau > quiet).collect();
        let rows: Vec<bool> = noisy.chunks(width).map(|row| row.contains(&true)).collect();
        if !rows.contains(&true) {
            return;
        }
        let next = filter(&rows);
        for p in (0..noisy.len()).filter(|p| noisy[*p]) {
            best.amplitude.values[p] = next.amplitude.values[p];
            best.deviation.values[p] = next.deviation.values[p];
            at(p);
        }
    }

    /// Minimum amplitude of a vessel at each pixel: the weakest vessel, or more beside a strong one, whose blur is no
    /// vessel; where line filters are used, no more than they can show.
    fn weakest_beside(&self, change: &Image, by_line: &[bool]) -> Image {
        let near = blob(change, &self.weight, NEAR_BLUR);
        let sure = map2(&near.amplitude, &near.deviation, |a, tau| (a - 2.0 * tau).max(0.0));
        let mut weakest = largest_within(&sure, LEAK_PIXELS);
        for (p, value) in weakest.values.iter_mut().enumerate() {
            *value = (LEAK * *value).max(self.weakest);
            if by_line[p] {
                *value = value.min(LINE_MOST * self.background.noise.values[p]);
            }
        }
        weakest
    }

    fn ratio(&self, seen: &Estimate, weakest: &Image) -> Image {
        let strongest = self.background.strongest;
        let values = seen.amplitude.values.iter().zip(&seen.deviation.values).zip(&weakest.values);
        let values = values.map(|((a, tau), low)| log_ratio(*a, *tau, *low, strongest.max(2.0 * low))).collect();
        Image { values, ..weakest.clone() }
    }

    /// Corrects the ratios of pixels that a vessel covers at every phase, where the background itself contains the vessel.
    /// Such a pixel counts where it changes at some phase and exceeds the opened background.
    fn with_covered_pixels(&self, image: &Image, phase: &Phase, largest: &[f32], filtered: bool) -> Image {
        let above = map2(image, &self.background.low, |y, b| y - b);
        let seen = if filtered {
            blob(&above, &self.weight, NEAR_BLUR)
        } else {
            Estimate { amplitude: above, deviation: self.background.noise.clone() }
        };
        let mut ratio = self.ratio(&seen, &phase.weakest);
        for ((covered, max), bare) in ratio.values.iter_mut().zip(largest).zip(&phase.ratio.values) {
            *covered = bare.max(covered.min(*max) - COVERED_COST);
        }
        ratio
    }
}

/// log p(a | vessel) - log p(a | none), clipped. A vessel's amplitude is log-uniform between `low` and `high`, and noise is
/// normal with standard deviation `tau`. An amplitude above any vessel's is no argument against a vessel.
fn log_ratio(a: f32, tau: f32, low: f32, high: f32) -> f32 {
    let scale = 0.5 / (tau * tau);
    let none = a * a * scale;
    if a > high {
        return none.clamp(LEAST, MOST);
    }
    // exp(-(a - a_k)^2 / 2 tau^2 + a^2 / 2 tau^2): the squares of a cancel here, before they cause a loss of precision.
    let step = (high / low).max(1.01).powf(1.0 / (AMPLITUDES - 1) as f32);
    let mut amplitude = low;
    let mut exponents = [0f32; AMPLITUDES];
    for exponent in &mut exponents {
        *exponent = (2.0 * a - amplitude) * amplitude * scale;
        amplitude *= step;
    }
    let max = exponents.iter().copied().fold(f32::MIN, f32::max);
    let sum: f32 = exponents.iter().map(|e| (e - max).exp()).sum();
    (max + (sum / AMPLITUDES as f32).ln()).clamp(LEAST, MOST)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ratios_are_those_of_the_densities() {
        // Compares with the definition in f64.
        for (a, tau, low, high) in [(0.3f32, 0.2f32, 0.1f32, 1.0f32), (0.0, 0.2, 0.1, 1.0), (0.12, 0.1, 0.08, 0.9)] {
            let (a64, tau64) = (f64::from(a), f64::from(tau));
            let normal = |x: f64| (-0.5 * ((a64 - x) / tau64).powi(2)).exp();
            let grow = f64::from(high / low).ln();
            let vessel: f64 =
                (0..8).map(|k| normal(f64::from(low) * (grow * f64::from(k) / 7.0).exp())).sum::<f64>() / 8.0;
            let want = (vessel / normal(0.0)).ln();
            let got = f64::from(log_ratio(a, tau, low, high));
            assert!((got - want.clamp(LEAST.into(), MOST.into())).abs() < 1e-4, "{got} against {want}");
        }
    }

    #[test]
    fn nothing_is_certain() {
        assert_eq!(log_ratio(10.0, 0.01, 0.1, 1.0), MOST);
        assert_eq!(log_ratio(0.9, 0.001, 0.1, 1.0), MOST);
        assert_eq!(log_ratio(-10.0, 0.01, 0.1, 1.0), LEAST);
    }
}
