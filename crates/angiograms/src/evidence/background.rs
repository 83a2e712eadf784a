//! The static background of a view without its vessels, and the noise of its pixels.

use crate::evidence::drift::Drift;
use crate::evidence::filters::map2;
use crate::evidence::interiors::{Interiors, Levels, interiors};
use crate::evidence::noise::{expected_minimum, noise_by_intensity};
use crate::evidence::series::{MIN_NOISE_SHARE, STRONGEST_PERCENTILE, Series, blur, opening_radius};
use crate::raster::{Image, dilate, median, opening, percentile};
use crate::scan::canvas::continued;
use rayon::prelude::*;

// Numbers of this file without another source, except that of the wide opening: chosen by the share of the vessels' cells that the soft
// hull keeps, on a procedural phantom and one real anatomy with several levels of noise.
/// Values within this many standard deviations of the background belong to it.
const BACKGROUND_SIGMAS: f32 = 2.0;
/// Number of iterations that select the phases belonging to the background.
const BACKGROUND_ROUNDS: usize = 4;
/// Blur before the strongest change is measured, pixels.
pub(crate) const STRONGEST_BLUR: f32 = 0.7;

/// Radius of the opening that removes vessels from the background, as a share of the image's smaller side: a field of view
/// that shows a heart is about twenty times as wide as its widest vessel.
pub(crate) const OPENING_SHARE: f64 = 0.03;
/// Radius of the opening that separates a moving heart or diaphragm from vessels, junctions and crossings, as a share of the image's
/// smaller side.
const WIDE_SHARE: f64 = 0.06;

/// The static background of a view, and the changes above it.
#[derive(Debug, Clone)]
pub struct Background {
    /// The images without wide motion; all fields below are derived from them.
    pub stilled: Series,
    /// The wide motion.
    pub drift: Drift,
    /// Mean of the phases at which no vessel covers the pixel.
    pub level: Image,
    /// Background where a vessel covers the pixel at every phase: the level after an opening that removes structures as
    /// thin as vessels.
    pub low: Image,
    /// Part of each phase above the level that is no wider than a vessel: a moving heart, lung or diaphragm changes wide
    /// areas. `None` where the view has no image.
    pub changes: Vec<Option<Image>>,
    /// Standard deviation of each pixel's noise; never zero.
    pub noise: Image,
    /// The strongest change of the view, a line integral: the contribution of the thickest vessel.
    pub strongest: f32,
}

/// Computes the noise of each pixel from the differences between successive phases.
fn noise(series: &Series) -> Vec<f32> {
    // Ratio of a normal distribution's standard deviation to its median absolute value.
    const MEDIAN_TO_DEVIATION: f32 = 1.4826;
    let images: Vec<&Image> = series.seen().collect();
    let pixels = images[0].values.len();
    let n = images.len() as f32;
    let mean: Vec<f32> = (0..pixels).map(|p| images.iter().map(|i| i.values[p]).sum::<f32>() / n).collect();
    let deviation: Vec<f32> = (0..pixels)
        .map(|p| {
            let mut steps: Vec<f32> = images.windows(2).map(|w| (w[1].values[p] - w[0].values[p]).abs()).collect();
            median(&mut steps) * (MEDIAN_TO_DEVIATION / std::f32::consts::SQRT_2)
        })
        .collect();
    noise_by_intensity(&mean, &deviation)
}

/// Lower mode of a pixel over the phases: the mean of the values no further than the noise above it. The iteration starts
/// from the minimum, corrected for the bias of a minimum of noisy values.
fn lower_mode(values: &[f32], noise: f32, bias: f32) -> f32 {
    let mut level = values.iter().copied().fold(f32::INFINITY, f32::min) + bias * noise;
    for _ in 0..BACKGROUND_ROUNDS {
        let inside = values.iter().filter(|v| **v < level + BACKGROUND_SIGMAS * noise);
        let (sum, count) = inside.fold((0.0, 0u32), |(sum, count), v| (sum + v, count + 1));
        if count > 0 {
            level = sum / count as f32;
        }
    }
    level
}

/// Raises the noise to the errors that a model has, which are a share of the strongest change.
fn raise_to_floor(noise: &mut [f32], strongest: f32) {
    let floor = (MIN_NOISE_SHARE * strongest).max(f32::MIN_POSITIVE);
    noise.iter_mut().for_each(|s| *s = s.max(floor));
}

impl Background {
    /// Analyses a view.
    pub fn new(series: Series) -> Background {
        if series.vessels_alone {
            return Background::without(series);
        }
        let drift = Drift::new(&series, &noise(&series));
        let stilled = drift.stilled(series);
        let images: Vec<&Image> = stilled.seen().collect();
        let (width, height) = (images[0].width, images[0].height);
        let image = |values: Vec<f32>| Image { width, height, values };
        let mut noise = noise(&stilled);
        let bias = expected_minimum(images.len()) as f32;
        // A pixel without noise still has rounding errors.
        let span = images.iter().flat_map(|i| &i.values).fold([f32::MAX, f32::MIN], |[l, h], v| [l.min(*v), h.max(*v)]);
        let min = 1e-6 * (span[1] - span[0]);
        let level: Vec<f32> = (0..width * height)
            .into_par_iter()
            .map(|p| lower_mode(&images.iter().map(|i| i.values[p]).collect::<Vec<_>>(), noise[p].max(min), bias))
            .collect();
        let mut level = image(level);
        // An opening of noise has a negative bias, an opening of the smoothed background a much smaller one.
        let narrow = opening_radius(OPENING_SHARE, width, height);
        let mut low = opening(&blur(&level, STRONGEST_BLUR), narrow);
        let wide = opening_radius(WIDE_SHARE, width, height);
        let mut changes = stilled.changes(&level, wide, None);
        let mut largest = largest_change(&changes, width, height);
        let mut strongest = percentile(&largest.values, STRONGEST_PERCENTILE);
        let levels = Levels { low: &low, radius: narrow, largest: &largest, strongest, noise: &noise, rounding: min };
        if let Some(Interiors { inside, background }) = interiors(&levels) {
            for pixel in (0..width * height).filter(|pixel| inside[*pixel]) {
                level.values[pixel] = level.values[pixel].min(background.values[pixel]);
                low.values[pixel] = low.values[pixel].min(background.values[pixel]);
            }
            changes = stilled.changes(&level, wide, Some(&inside));
            largest = largest_change(&changes, width, height);
            strongest = percentile(&largest.values, STRONGEST_PERCENTILE);
        }
        raise_to_floor(&mut noise, strongest);
        low.values.iter_mut().zip(&level.values).for_each(|(low, b)| *low = low.min(*b));
        Background { level, low, changes, noise: image(noise), strongest, drift, stilled }
    }

    /// Returns the background, 0, of images that show vessels and nothing else.
    fn without(stilled: Series) -> Background {
        let mut noise = noise(&stilled);
        let changes = stilled.images.clone();
        let [width, height] = stilled.seen().next().map_or([0, 0], |image| [image.width, image.height]);
        let strongest = percentile(&largest_change(&changes, width, height).values, STRONGEST_PERCENTILE);
        raise_to_floor(&mut noise, strongest);
        let level = Image::zeros(width, height);
        let noise = Image { values: noise, ..level };
        Background { low: level.clone(), level, changes, noise, strongest, drift: Drift::default(), stilled }
    }

    /// Places the background in the corner of a canvas (columns, rows), and continues its edges there.
    pub(super) fn on_canvas(self, canvas: [usize; 2]) -> Background {
        let all = |images: Vec<Option<Image>>| images.into_iter().map(|i| Some(continued(i?, canvas))).collect();
        Background {
            level: continued(self.level, canvas),
            low: continued(self.low, canvas),
            changes: all(self.changes),
            noise: continued(self.noise, canvas),
            stilled: Series { images: all(self.stilled.images), ..self.stilled },
            ..self
        }
    }
}

impl Series {
    /// Returns the change of each image above the level, without its wide part: the part that an opening by `radius` retains. Where a
    /// wide vessel is, its change stays whole.
    fn changes(&self, level: &Image, radius: usize, of_wide_vessels: Option<&[bool]>) -> Vec<Option<Image>> {
        let change = |seen: &Image| {
            let change = map2(seen, level, |y, b| y - b);
            let mut wide = opening(&blur(&change, STRONGEST_BLUR), radius);
            for (wide, _) in
                wide.values.iter_mut().zip(of_wide_vessels.unwrap_or_default()).filter(|(_, inside)| **inside)
            {
                *wide = 0.0;
            }
            map2(&change, &wide, |d, wide| d - wide.max(0.0))
        };
        self.images.par_iter().map(|seen| seen.as_ref().map(change)).collect()
    }
}

/// Returns the largest change of each pixel over the phases, slightly blurred.
fn largest_change(changes: &[Option<Image>], width: usize, height: usize) -> Image {
    let values = changes.par_iter().flatten().map(|c| blur(c, STRONGEST_BLUR).values).reduce(
        || vec![f32::MIN; width * height],
        |mut max, values| {
            max.iter_mut().zip(values).for_each(|(max, value)| *max = max.max(value));
            max
        },
    );
    Image { width, height, values }
}

/// Maximum within `radius` pixels along both axes.
pub fn largest_within(image: &Image, radius: usize) -> Image {
    dilate(image, radius)
}
