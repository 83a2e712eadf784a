//! R-peaks of a run without ECG, from the motion of its vessels: their appearance repeats once a beat, and its variation within
//! the beat follows the contraction of a ventricle.

use crate::error::{Error, Result};
use crate::raster::{Image, opening};
use crate::scan::gating::{RPeaks, SYSTOLE_S, contraction, two_segment_fraction};
use rayon::prelude::*;

/// Longest side of the reduced images, pixels.
const SIDE: usize = 64;
/// Accepted lengths of a beat, seconds: 35 to 180 beats per minute.
const BEATS_S: std::ops::RangeInclusive<f64> = 60.0 / 180.0..=60.0 / 35.0;
/// Minimum length of a run, beats, so that half a beat is seen twice.
const MIN_BEATS: f64 = 1.5;
/// Minimum rise of the correlation one beat later, as a share of its drop from neighbouring images to the least similar ones.
const MIN_RETURN: f64 = 0.2;
/// Minimum rise of the correlation in absolute terms, because noise alone causes some similarity.
const MIN_LIKENESS: f64 = 0.02;
/// Share of the highest rise that makes a time the length of a beat; the shortest such time is used, because longer ones are
/// several beats.
const AS_GOOD: f64 = 0.8;
/// Number of steps of the search for the R-peak within a beat.
const STEPS: usize = 200;
/// Iterations of the power method.
const ROUNDS: usize = 100;

/// A steady beat found in images.
#[derive(Debug, Clone, PartialEq)]
pub struct ImageBeat {
    /// R-peaks from before the first image until after the last.
    pub r_peaks: RPeaks,
    /// Heart rate, beats per minute.
    pub beats_per_min: f64,
    /// Correlation of the vessels' motion with the contraction of a ventricle, -1 to 1.
    pub likeness: f64,
}

/// Finds the beat in images of one view at increasing times, seconds. `vessel_pixels` is half the width of the widest vessel.
///
/// # Errors
/// [`Error::Config`] when the images show fewer than one and a half beats, or do not repeat.
pub fn beat(images: &[&Image], times_s: &[f64], vessel_pixels: usize) -> Result<ImageBeat> {
    let refused = |problem: String| Error::config("gating", "images", problem);
    let n = images.len();
    let frame_s = match (times_s.first(), times_s.last()) {
        (Some(first), Some(last)) if n > 2 && last > first => (last - first) / (n - 1) as f64,
        _ => return Err(refused(format!("{n} images are too few to show a beat"))),
    };
    let uneven = times_s.windows(2).any(|w| (w[1] - w[0] - frame_s).abs() > 0.5 * frame_s);
    if uneven {
        return Err(refused("the times of the images are not equally spaced: give R-peaks or a heart rate".into()));
    }
    let vessels: Vec<Vec<f32>> = images.par_iter().map(|image| vessels(image, vessel_pixels)).collect();
    let frames = period(&likeness(&centred(&vessels, n)), frame_s).ok_or_else(|| {
        refused(format!(
            "{n} images in {:.1} s do not repeat, as they would in one and a half beats of a regular rhythm without breathing: give \
             R-peaks, a heart rate or the phases of the frames, or choose other frames",
            times_s[n - 1] - times_s[0]
        ))
    })?;
    let beat_s = frames * frame_s;
    let course = principal_course(&likeness(&centred(&vessels, frames.round() as usize)));
    let times: Vec<f64> = times_s.iter().map(|t| t - times_s[0]).collect();
    let (r_peak_s, likeness) = best_r_peak(&course, &times, beat_s);
    let first = times_s[0] + r_peak_s - beat_s;
    let count = ((times_s[n - 1] - first) / beat_s).ceil() as usize + 2;
    let r_peaks = RPeaks::new(&(0..count).map(|k| first + k as f64 * beat_s).collect::<Vec<f64>>())?;
    Ok(ImageBeat { r_peaks, beats_per_min: 60.0 / beat_s, likeness })
}

/// Extracts thin structures, such as vessels, on a coarser pixel grid and divides them by their sum, so that the amount of
/// contrast has no effect.
pub(super) fn vessels(image: &Image, vessel_pixels: usize) -> Vec<f32> {
    let surroundings = opening(image, vessel_pixels);
    let factor = image.width.max(image.height).div_ceil(SIDE);
    let (width, height) = (image.width / factor, image.height / factor);
    let mut out = vec![0.0; width * height];
    for y in 0..height * factor {
        for x in 0..width * factor {
            let p = y * image.width + x;
            out[y / factor * width + x / factor] += image.values[p] - surroundings.values[p];
        }
    }
    let sum: f32 = out.iter().sum();
    out.iter_mut().for_each(|v| *v /= sum.max(f32::MIN_POSITIVE));
    out
}

/// Subtracts from each image the mean of `window` images around it, which removes slower changes such as contrast and
/// breathing.
fn centred(images: &[Vec<f32>], window: usize) -> Vec<Vec<f32>> {
    let n = images.len();
    let window = window.clamp(1, n);
    let less_mean = |i: usize| {
        let first = i.saturating_sub(window / 2).min(n - window);
        let mut out = images[i].clone();
        for other in &images[first..first + window] {
            out.iter_mut().zip(other).for_each(|(o, v)| *o -= v / window as f32);
        }
        out
    };
    (0..n).into_par_iter().map(less_mean).collect()
}

/// Scalar products of all pairs of images.
fn likeness(images: &[Vec<f32>]) -> Vec<Vec<f64>> {
    let product = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
    images.par_iter().map(|a| images.iter().map(|b| product(a, b)).collect()).collect()
}

/// Number of images per beat, if the images repeat.
fn period(likeness: &[Vec<f64>], frame_s: f64) -> Option<f64> {
    let n = likeness.len();
    let longest = (((n - 1) as f64) / MIN_BEATS).min(BEATS_S.end() / frame_s).floor() as usize;
    let alike: Vec<f64> = (0..n).map(|lag| mean_after(likeness, lag)).collect();
    let valley = |lag: usize| alike[..lag].iter().copied().fold(f64::MAX, f64::min);
    let shortest = ((BEATS_S.start() / frame_s).floor() as usize).max(1);
    let peaks: Vec<usize> = (shortest..=longest)
        .filter(|lag| lag + 1 < n && alike[*lag] > alike[lag - 1] && alike[*lag] >= alike[lag + 1])
        .collect();
    let returns = |lag: usize| alike[lag] - valley(lag);
    let best = peaks.iter().map(|lag| returns(*lag)).fold(0.0, f64::max);
    let min = (MIN_RETURN * (alike[1] - valley(n / 2))).max(MIN_LIKENESS);
    let first = peaks.into_iter().find(|lag| returns(*lag) >= AS_GOOD * best && best >= min)?;
    // Times of several beats determine the length of one beat more precisely.
    let mut found = summit(&alike, first);
    for beats in 2.. {
        let about = (found * f64::from(beats)).round() as usize;
        let around = about.saturating_sub(first / 4)..(about + first / 4 + 1).min(n);
        let Some(lag) = around.max_by(|a, b| alike[*a].total_cmp(&alike[*b])) else { break };
        if lag as f64 > (n - 1) as f64 / MIN_BEATS || lag + 1 >= n {
            break;
        }
        found = summit(&alike, lag) / f64::from(beats);
    }
    Some(found)
}

/// Mean correlation of images that are `lag` images apart.
fn mean_after(likeness: &[Vec<f64>], lag: usize) -> f64 {
    let n = likeness.len();
    let (product, power) = (0..n - lag).fold((0.0, f64::MIN_POSITIVE), |(product, power), i| {
        let j = i + lag;
        (product + likeness[i][j], power + (likeness[i][i] * likeness[j][j]).sqrt())
    });
    product / power
}

/// Position of the maximum of a parabola through a value and its neighbours.
fn summit(values: &[f64], at: usize) -> f64 {
    let (before, here, after) = (values[at - 1], values[at], values[at + 1]);
    let bend = before - 2.0 * here + after;
    at as f64 + if bend < 0.0 { (0.5 * (before - after) / bend).clamp(-0.5, 0.5) } else { 0.0 }
}

/// Amount of the strongest pattern of change in each image: the first eigenvector of their scalar products.
fn principal_course(likeness: &[Vec<f64>]) -> Vec<f64> {
    let n = likeness.len();
    let strongest = (0..n).max_by(|a, b| likeness[*a][*a].total_cmp(&likeness[*b][*b])).unwrap_or(0);
    let mut course = likeness[strongest].clone();
    for _ in 0..ROUNDS {
        let norm = course.iter().map(|c| c * c).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
        course.iter_mut().for_each(|c| *c /= norm);
        course = likeness.iter().map(|row| row.iter().zip(&course).map(|(a, b)| a * b).sum()).collect();
    }
    course
}

/// R-peak, seconds from the first image, for which the vessels' motion correlates best with the contraction of a ventricle, and
/// the correlation.
fn best_r_peak(course: &[f64], times_s: &[f64], beat_s: f64) -> (f64, f64) {
    let correlation = |r_peak_s: f64| {
        let since = |t: &f64| (t - r_peak_s).rem_euclid(beat_s);
        let expected: Vec<f64> =
            times_s.iter().map(|t| contraction(two_segment_fraction(since(t), beat_s, SYSTOLE_S))).collect();
        correlation(course, &expected)
    };
    let candidates = (0..STEPS).map(|step| beat_s * step as f64 / STEPS as f64);
    // The sign of the pattern during contraction is unknown, so the absolute value is used.
    let rated = candidates.map(|at| (at, correlation(at).abs()));
    rated.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((0.0, 0.0))
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |v: &[f64]| v.iter().sum::<f64>() / v.len() as f64;
    let (mean_a, mean_b) = (mean(a), mean(b));
    let sum = |f: &dyn Fn(f64, f64) -> f64| a.iter().zip(b).map(|(a, b)| f(a - mean_a, b - mean_b)).sum::<f64>();
    sum(&|a, b| a * b) / (sum(&|a, _| a * a) * sum(&|_, b| b * b)).sqrt().max(f64::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::gating::BeatScaling;

    const SIZE: usize = 48;

    /// Vessels of three pixels' width that swing with a beat before a static background, with arriving contrast and a drift by
    /// breathing.
    fn run(n: usize, frames_per_s: f64, beat_s: f64, first_r_s: f64) -> (Vec<Image>, Vec<f64>) {
        let times: Vec<f64> = (0..n).map(|i| 2.0 + i as f64 / frames_per_s).collect();
        let image = |t: &f64| {
            let since = (t - 2.0 - first_r_s).rem_euclid(beat_s);
            let squeeze = contraction(two_segment_fraction(since, beat_s, SYSTOLE_S));
            let breath = 0.8 * (1.1 * t).sin();
            let contrast = 1.0 - 0.6 * (-(t - 1.5)).exp();
            let values = (0..SIZE * SIZE).map(|p| {
                let (x, y) = ((p % SIZE) as f64, (p / SIZE) as f64);
                let still = 2.0 + 0.02 * x + f64::from(u8::from((x - y).abs() < 1.0));
                let vessel = |at: f64, swing: f64| {
                    let line = at + 0.1 * y + swing * squeeze + breath;
                    (-(x - line).powi(2) / 2.0).exp()
                };
                (still + contrast * (vessel(12.0, 6.0) + vessel(30.0, -4.0))) as f32
            });
            Image { width: SIZE, height: SIZE, values: values.collect() }
        };
        (times.iter().map(image).collect(), times)
    }

    #[test]
    fn the_beat_of_swinging_vessels_is_found() {
        for (rate, n, frames_per_s, first_r_s) in
            [(60.0, 45, 15.0, 0.3), (95.0, 90, 30.0, 0.05), (72.0, 36, 15.0, 0.7), (50.0, 42, 15.0, 0.9)]
        {
            let beat_s = 60.0 / rate;
            let (images, times) = run(n, frames_per_s, beat_s, first_r_s);
            let images: Vec<&Image> = images.iter().collect();
            let found = beat(&images, &times, 3).unwrap();
            assert!((found.beats_per_min / rate - 1.0).abs() < 0.02, "{rate}: {found:?}");
            // Fraction of the beat at the first R-peak, on a cyclic beat.
            let off = (2.0 + first_r_s - found.r_peaks.times_s()[0]).rem_euclid(beat_s) / beat_s;
            assert!(off.min(1.0 - off) < 0.04, "{rate} per minute: R-peak off by {off} of a beat; {found:?}");
            assert!(found.likeness > 0.8, "{found:?}");
            let none = times.iter().find(|t| found.r_peaks.beat_time(**t, 10, BeatScaling::default()).is_none());
            assert_eq!(none, None, "all images have a phase");
        }
    }

    #[test]
    fn what_does_not_return_is_refused() {
        let (images, times) = run(40, 15.0, 1.0, 0.3);
        let refused = |images: &[&Image], times: &[f64]| beat(images, times, 3).unwrap_err().to_string();
        let all: Vec<&Image> = images.iter().collect();
        assert!(refused(&all[..14], &times[..14]).contains("one and a half"), "fewer than one and a half beats");
        assert!(refused(&[&images[0]; 40], &times).contains("do not repeat"), "nothing moves");
        assert!(refused(&all[..1], &times[..1]).contains("1 images"));
        let uneven: Vec<f64> = times.iter().map(|t| if *t > 3.0 { t + 1.0 } else { *t }).collect();
        assert!(refused(&all, &uneven).contains("not equally spaced"));
    }
}
