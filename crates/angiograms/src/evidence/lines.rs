//! Vessels of a single frame: thin dark structures that a line filter confirms, beyond what the run shows without contrast agent. Unlike a
//! difference over the beat, this needs no background at rest.
//!
//! The line filter is the largest eigenvalue of the Hessian over several scales (Frangi et al., "Multiscale vessel enhancement filtering",
//! MICCAI 1998, LNCS 1496:130), less the other one, so that a blob is no line; the threshold has hysteresis (Canny, IEEE PAMI 8:679, 1986).
//! Lengths were chosen on twelve clinical runs of two patients with 0.43 mm per pixel at the isocentre.

use crate::evidence::filters::{gaussian, map2, rows_and_columns, separable};
use crate::raster::{Image, dilate, median, opening, percentile};
use rayon::prelude::*;

// Numbers of this file without another source: developed on simulated runs and on twelve clinical runs of two patients, which are
// therefore no independent test (docs/tried.md, runs without ECG).
/// Radius of the opening that a thin structure does not survive, mm at the isocentre: vessels up to 7 mm wide are thin.
const THIN_MM: f64 = 3.4;
/// Standard deviation of the blur before the opening, mm, so that it does not follow single noisy pixels.
const BLUR_MM: f64 = 0.35;
/// Scales of the line filter, mm: half of the widths of vessels.
const SCALES_MM: [f64; 4] = [0.39, 0.6, 0.9, 1.38];
/// Smallest scale, pixels: below it, a line is one noisy pixel wide. Smaller ones make pieces of noise in dense parts of the chest
/// (docs/tried.md).
const MIN_SCALE_PIXELS: f32 = 0.9;
/// Contrast of a frame, a share of that of the run's fullest frames, below which it is empty.
pub const EMPTY: f64 = 0.25;
/// Minimum number of empty frames from which structures at rest are taken; with fewer, all frames are used.
const MIN_EMPTY: usize = 4;
/// Percentile over all frames that stands for a structure at rest where empty frames are missing.
const REST_PERCENTILE: f64 = 0.15;
/// Percentile over the pixels of the line filter's response to noise.
const NOISE_PERCENTILE: f64 = 0.8;
/// Standard deviation of the neighbourhood in which noise is the same, mm.
const NEIGHBOURHOOD_MM: f64 = 5.0;
/// Response of the line filter from which a line is certain, in units of that noise.
const CERTAIN: f32 = 3.0;
/// Least such response, as a share of the response of the most contrasted half percent of the pixels of filled frames.
const CERTAIN_SHARE: f32 = 0.15;
/// Response at which a line ends, as a share of that at which it is certain.
const ENDS: f32 = 0.5;
/// Contrast of a frame from which it is filled, for the share above.
const FILLED: f64 = 0.7;
/// Minimum area of a piece of vessel, pixels: noise makes smaller ones.
const MIN_PIXELS: usize = 30;

/// Blurs an image by a Gaussian of a standard deviation in pixels.
pub fn blurred(image: &Image, pixels: f64) -> Image {
    separable(image, &gaussian(pixels as f32))
}

/// Thin structures of a frame.
#[derive(Debug, Clone)]
pub struct Thin {
    /// The blurred image less its opening, line integrals: it shows where thin structures are.
    pub smooth: Image,
    /// The image less the same opening: it shows how much there is.
    pub sharp: Image,
}

/// Finds the thin structures of a frame. `mm` is the size of a pixel at the isocentre.
pub fn thin_structures(image: &Image, mm: f64) -> Thin {
    let blurred = blurred(image, BLUR_MM / mm);
    let wide = opening(&blurred, (THIN_MM / mm).round().max(1.0) as usize);
    let [smooth, sharp] = [&blurred, image].map(|image| map2(image, &wide, |value, wide| value - wide));
    Thin { smooth, sharp }
}

/// Strength of lines in a frame, about 0.6 of the line integral of a bar at its own scale; 0 where there is no line.
pub fn line_strength(image: &Image, mm: f64) -> Image {
    let mut strength = Image::zeros(image.width, image.height);
    for scale in SCALES_MM {
        let sigma = ((scale / mm) as f32).max(MIN_SCALE_PIXELS);
        let [smooth, slope, bend] = derivatives(sigma);
        let (xx, yy) = (rows_and_columns(image, &bend, &smooth), rows_and_columns(image, &smooth, &bend));
        let xy = rows_and_columns(image, &slope, &slope);
        for (p, out) in strength.values.iter_mut().enumerate() {
            let (xx, yy, xy) = (xx.values[p], yy.values[p], xy.values[p]);
            let (mean, spread) = (0.5 * (xx + yy), (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt());
            *out = out.max(sigma * sigma * (spread - mean - (mean + spread).abs()));
        }
    }
    strength
}

/// Kernels of a Gaussian and of its first two derivatives.
fn derivatives(sigma: f32) -> [Vec<f32>; 3] {
    let smooth = gaussian(sigma);
    let middle = (smooth.len() / 2) as i32;
    let at = |k: usize| (k as i32 - middle) as f32 / sigma;
    let slope = smooth.iter().enumerate().map(|(k, g)| at(k) / sigma * g).collect();
    let bend: Vec<f32> = smooth.iter().enumerate().map(|(k, g)| (at(k) * at(k) - 1.0) / (sigma * sigma) * g).collect();
    // A flat image must have no second derivative, although the kernel is cut off.
    let excess = bend.iter().sum::<f32>() / bend.len() as f32;
    [smooth, slope, bend.iter().map(|b| b - excess).collect()]
}

/// A frame after the displacement of its background was removed.
#[derive(Debug, Clone)]
pub struct SteadyFrame {
    /// Its thin structures, without blur ([`Thin::sharp`]).
    pub thin: Image,
    /// Its lines ([`line_strength`]).
    pub lines: Image,
    /// Contrast of its vessels, a share of that of the run's fullest frames.
    pub contrast: f64,
}

/// Line integrals of the vessels of each frame of a run, 0 beside vessels and outside `shown`.
pub fn vessels(frames: &[SteadyFrame], shown: &[bool], mm: f64) -> Vec<Image> {
    let empty: Vec<&SteadyFrame> = frames.iter().filter(|frame| frame.contrast < EMPTY).collect();
    let with_empty = empty.len() >= MIN_EMPTY;
    let share = if with_empty { 0.5 } else { REST_PERCENTILE };
    let resting: Vec<&SteadyFrame> = if with_empty { empty } else { frames.iter().collect() };
    let at_rest = |of: fn(&SteadyFrame) -> &Image| over_frames(resting.iter().map(|frame| of(frame)), share);
    // A displacement that is a pixel wrong must not leave lines; of the integrals, a maximum of noise would be taken away.
    let (thin, lines) = (at_rest(|frame| &frame.thin), dilate(&at_rest(|frame| &frame.lines), 1));
    let seen = |image: &Image| -> Vec<f32> {
        image.values.iter().zip(shown).filter(|(_, shown)| **shown).map(|(value, _)| *value).collect()
    };
    let beyond = |frame: &SteadyFrame| map2(&frame.lines, &lines, |value, rest| (value - rest).max(0.0));
    let of_rest: Vec<Image> = resting.par_iter().map(|frame| beyond(frame)).collect();
    let noise: Vec<f32> = of_rest.par_iter().map(|image| percentile(&seen(image), NOISE_PERCENTILE)).collect();
    let filled = frames.par_iter().filter(|frame| frame.contrast > FILLED);
    let strongest: Vec<f32> = filled.map(|frame| percentile(&seen(&frame.lines), 0.995)).collect();
    let (noise, least) = (CERTAIN * middle(noise), CERTAIN_SHARE * middle(strongest));
    // Few photons come through dense parts of the patient: noise is larger there. Frames with vessels do not show where.
    let local = if with_empty { local_noise(&of_rest, shown, mm) } else { vec![1.0; shown.len()] };
    let certain: Vec<f32> = local.iter().map(|local| (noise * local).max(least)).collect();
    let marked = |frame: &SteadyFrame| {
        let mut strength = beyond(frame);
        strength.values.iter_mut().zip(shown).filter(|(_, shown)| !**shown).for_each(|(value, _)| *value = 0.0);
        dilate(&connected(&strength, &certain), 1)
    };
    let marked: Vec<Image> = frames.par_iter().map(marked).collect();
    let of_frame = |(frame, kept): (&SteadyFrame, &Image)| {
        let mut vessels = map2(&frame.thin, &thin, |value, rest| (value - rest).max(0.0));
        vessels.values.iter_mut().zip(&kept.values).for_each(|(value, kept)| *value *= kept);
        vessels
    };
    frames.par_iter().zip(&marked).map(of_frame).collect()
}

/// Response of the line filter to noise around each pixel, in units of its median.
fn local_noise(resting: &[Image], shown: &[bool], mm: f64) -> Vec<f32> {
    let weights = Image { values: shown.iter().map(|shown| f32::from(u8::from(*shown))).collect(), ..resting[0] };
    let mut mean = Image::zeros(weights.width, weights.height);
    for (p, out) in mean.values.iter_mut().enumerate().filter(|(p, _)| shown[*p]) {
        *out = resting.iter().map(|image| image.values[p]).sum::<f32>() / resting.len() as f32;
    }
    let [mean, weights] = [&mean, &weights].map(|of| blurred(of, NEIGHBOURHOOD_MM / mm));
    let local: Vec<f32> =
        mean.values.iter().zip(&weights.values).map(|(mean, weight)| mean / weight.max(1e-3)).collect();
    let usual = middle(local.iter().zip(shown).filter(|(_, shown)| **shown).map(|(local, _)| *local).collect());
    local.into_iter().map(|local| local / usual.max(f32::MIN_POSITIVE)).collect()
}

fn middle(mut values: Vec<f32>) -> f32 {
    median(&mut values)
}

/// Value of each pixel below which a share of the frames lies.
pub fn over_frames<'a>(frames: impl Iterator<Item = &'a Image>, share: f64) -> Image {
    let frames: Vec<&Image> = frames.collect();
    let mut out = frames.first().map_or(Image::zeros(0, 0), |first| Image::zeros(first.width, first.height));
    let pixel = |(p, out): (usize, &mut f32)| {
        *out = percentile(&frames.iter().map(|frame| frame.values[p]).collect::<Vec<f32>>(), share);
    };
    out.values.par_iter_mut().enumerate().for_each(pixel);
    out
}

/// Marks with 1 the pieces (8 neighbours) above the lower threshold that hold a certain pixel and enough pixels.
fn connected(strength: &Image, certain: &[f32]) -> Image {
    let (width, height) = (strength.width, strength.height);
    let mut kept = Image::zeros(width, height);
    let mut visited = vec![false; width * height];
    for start in (0..width * height).filter(|p| strength.values[*p] > certain[*p]) {
        if visited[start] {
            continue;
        }
        visited[start] = true;
        let mut piece = vec![start];
        let mut next = 0;
        while let Some(p) = piece.get(next).copied() {
            next += 1;
            let (x, y) = (p % width, p / width);
            for q in (y.saturating_sub(1)..(y + 2).min(height))
                .flat_map(|y| (x.saturating_sub(1)..(x + 2).min(width)).map(move |x| y * width + x))
            {
                if !visited[q] && strength.values[q] > ENDS * certain[q] {
                    visited[q] = true;
                    piece.push(q);
                }
            }
        }
        if piece.len() >= MIN_PIXELS {
            piece.iter().for_each(|p| kept.values[*p] = 1.0);
        }
    }
    kept
}
