//! Motion in the angiograms, found without segmentation: each view's static background, its noise, and the motion hull, the set
//! of points whose projection changes over time in every view that sees them.

use crate::evidence::noise::{expected_minimum, noise_by_intensity};
use crate::raster::{Image, dilate, median, opening, percentile};
use crate::scan::canvas::{continued, framed};
use crate::scan::dataset::Dataset;
use rayon::prelude::*;

/// Temporal behaviour of one training view; its pixels are those of the dataset's canvas.
#[derive(Debug, Clone)]
pub struct ViewMotion {
    /// Index into [`Dataset::views`].
    pub view: usize,
    /// Upper bound of the static background: each pixel's smallest line integral over the phases, corrected for
    /// the bias that taking a minimum of noisy values has.
    pub background: Vec<f32>,
    /// Lower bound of the static background: what remains of it without structures as thin as vessels, since a
    /// vessel that covers a pixel at every phase is part of the minimum.
    pub background_low: Vec<f32>,
    /// Largest integral above the background over the phases.
    pub range: Vec<f32>,
    /// Standard deviation of a pixel's noise.
    pub noise: Vec<f32>,
    /// Pixels that move at some phase.
    pub moving: Vec<bool>,
    /// Pixels that stand out of the background at each phase of the dataset, or in an image taken between it and a neighbouring
    /// phase; empty for phases that are not seen.
    pub moving_at: Vec<Vec<bool>>,
    /// Training phases of this view.
    pub n_phases: usize,
}

impl ViewMotion {
    /// Returns the lower and upper bound of the static background at each pixel.
    pub fn background_bounds(&self) -> impl Iterator<Item = [f32; 2]> {
        self.background_low.iter().zip(&self.background).map(|(low, high)| [*low, *high])
    }

    /// Places this motion, found on images of `size` (columns, rows), in the corner of a canvas, beyond which nothing moves.
    fn on_canvas(self, size: [usize; 2], canvas: [usize; 2]) -> ViewMotion {
        if size == canvas {
            return self;
        }
        let goes_on = |values: Vec<f32>| continued(Image { width: size[0], height: size[1], values }, canvas).values;
        let still = |moving: Vec<bool>| framed(&moving, size, canvas, false);
        let of_phase = |moving: Vec<bool>| if moving.is_empty() { moving } else { still(moving) };
        ViewMotion {
            background: goes_on(self.background),
            background_low: goes_on(self.background_low),
            range: goes_on(self.range),
            noise: goes_on(self.noise),
            moving: still(self.moving),
            moving_at: self.moving_at.into_iter().map(of_phase).collect(),
            ..self
        }
    }
}

/// Standard deviations of noise by which the temporal range of a moving pixel exceeds what noise gives. With 3 and 4, Dice on real
/// anatomy is .66 and .70 instead of .73 (docs/tried.md).
const NOISE_SIGMAS: f32 = 6.0;
/// Half width of the widest vessel, pixels: structures up to this width may be hidden in the static background.
const VESSEL_PIXELS: usize = 3;
/// Number of views below which views carve little. With four views, the threshold of fewer views costs .019 of Dice (docs/tried.md).
const MANY_VIEWS: usize = 4;

/// Thresholds of motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Thresholds {
    /// A pixel moves, with four views or more, when its range also exceeds this share of the strongest change in its view.
    pub min_share: f64,
    /// Threshold like `min_share` for fewer than four views: they carve less, so the threshold has to be higher.
    pub min_share_few_views: f64,
    /// Pixels by which moving regions grow.
    pub dilate_pixels: u32,
}

impl Default for Thresholds {
    /// Thresholds of the presets that are tuned: of a hull with which the default phantom is reconstructed best.
    fn default() -> Thresholds {
        Thresholds { min_share: 0.05, min_share_few_views: 0.08, dilate_pixels: 0 }
    }
}

/// Analyses each training view.
pub fn analyse(dataset: &Dataset, thresholds: Thresholds) -> Vec<ViewMotion> {
    let views = dataset.training_views();
    let few = views.len() < MANY_VIEWS;
    let min_share = if few { thresholds.min_share_few_views } else { thresholds.min_share } as f32;
    views
        .into_par_iter()
        .map(|view| {
            let mut frames: Vec<_> = dataset.training().iter().filter(|f| f.view == view).collect();
            frames.sort_by_key(|f| f.phase);
            let n = frames.len();
            let size = dataset.views[view].size;
            let pixels = size[0] * size[1];
            let images: Vec<_> = frames.iter().map(|f| dataset.own(view, &f.integrals)).collect();
            let at = |p: usize| images.iter().map(move |image| image[p]);
            let mean: Vec<f32> = (0..pixels).map(|p| at(p).sum::<f32>() / n as f32).collect();
            // Differences of successive phases over sqrt 2: a slow change over the beat contributes little.
            let deviation: Vec<f32> = (0..pixels)
                .map(|p| {
                    let mut steps: Vec<f32> = images.windows(2).map(|w| (w[1][p] - w[0][p]).abs()).collect();
                    median(&mut steps) * (1.4826 / std::f32::consts::SQRT_2)
                })
                .collect();
            let noise = noise_by_intensity(&mean, &deviation);
            let bias = expected_minimum(n) as f32;
            let lowest: Vec<f32> = (0..pixels).map(|p| at(p).fold(f32::INFINITY, f32::min)).collect();
            let highest: Vec<f32> = (0..pixels).map(|p| at(p).fold(f32::NEG_INFINITY, f32::max)).collect();
            let background: Vec<f32> =
                lowest.iter().zip(&noise).map(|(l, s)| if n > 1 { l + bias * s } else { *l }).collect();
            let image = |values: Vec<f32>| Image { width: size[0], height: size[1], values };
            let background_low = match n > 1 {
                true => opening(&image(background.clone()), VESSEL_PIXELS).values,
                false => background.clone(),
            };
            let range: Vec<f32> = highest.iter().zip(&background).map(|(h, b)| (h - b).max(0.0)).collect();
            let strongest = percentile(&range, 0.995);
            let threshold = |p: usize| (NOISE_SIGMAS * noise[p]).max(min_share * strongest);
            let grow = |marked: &dyn Fn(usize) -> bool| -> Vec<bool> {
                let marked = (0..pixels).map(|p| f32::from(u8::from(n > 1 && marked(p))));
                let grown = dilate(&image(marked.collect()), thresholds.dilate_pixels as usize);
                grown.values.iter().map(|v| *v > 0.0).collect()
            };
            let mut moving_at = vec![Vec::new(); dataset.n_phases as usize];
            for (frame, values) in frames.iter().zip(&images) {
                let stands_out = |p: usize| values[p] - background_low[p] > threshold(p);
                let seen = grow(&|p| range[p] > threshold(p) && stands_out(p));
                // A structure seen between two phases, or at another moment near one, is not ruled out at either of them.
                for (phase, _) in
                    frame.beat_time().shown(dataset.n_phases).into_iter().filter(|(_, share)| *share > 0.0)
                {
                    let moving: &mut Vec<bool> = &mut moving_at[phase];
                    moving.resize(pixels, false);
                    moving.iter_mut().zip(&seen).for_each(|(moving, seen)| *moving |= seen);
                }
            }
            let moving = grow(&|p| range[p] > threshold(p));
            let motion = ViewMotion { view, moving, moving_at, background, background_low, range, noise, n_phases: n };
            motion.on_canvas(size, dataset.canvas())
        })
        .collect()
}
