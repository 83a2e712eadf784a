//! Length of a beat, from how alike the frames of a run are. Two frames are compared at the displacement where they are most alike, so that
//! neither a panned table nor breathing hides that the heart returns.

use crate::cine::displacement::{product, reduced, summit};
use crate::raster::Image;
use rayon::prelude::*;

// Numbers of this file without another source: developed on simulated runs and on twelve clinical runs of two patients, which are
// therefore no independent test (docs/tried.md, runs without ECG).
/// Shorter side of the reduced images, pixels.
const SIDE: usize = 96;
/// Furthest displacement of two frames, reduced pixels.
const REACH: i32 = 12;
/// Share of a reduced pixel that must show the patient.
const WHOLE: f32 = 0.99;
/// Accepted heart rates, beats per minute.
const RATES: [f64; 2] = [40.0, 140.0];
/// Minimum length of a run, beats.
const MIN_BEATS: f64 = 1.25;
/// Share of the highest return that makes a time the length of a beat; the shortest such time is used, because longer ones are several beats.
const AS_GOOD: f64 = 0.7;
/// Minimum return: rise of the similarity one beat later, as a share of its fall from neighbouring frames to the least similar ones. Real runs
/// have .46 to 1.3.
pub(super) const MIN_RETURN: f64 = 0.35;
/// Largest number of beats that refine the length of one.
const MAX_BEATS: usize = 5;

/// A steady rhythm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rhythm {
    /// Length of a beat, frames.
    pub frames: f64,
    /// Return of the similarity one beat later.
    pub returns: f64,
}

/// Similarity of frames by the number of frames between them.
pub(super) struct Similarity(Vec<Vec<f32>>);

impl Similarity {
    /// Compares all frames, given by their thin structures, where they show the patient.
    pub(super) fn of(thin: &[Image], shown: &[bool]) -> Similarity {
        let values = shown.iter().map(|shown| f32::from(u8::from(*shown))).collect();
        let weight = Image { values, ..*thin.first().unwrap_or(&Image::zeros(0, 0)) };
        let coarse: Vec<[Reduced; 2]> = thin
            .par_iter()
            .map(|image| {
                let factor = (image.width.min(image.height) as f64 / SIDE as f64).round().max(1.0) as usize;
                let [fine, weight] = [image, &weight].map(|of| reduced(of, factor));
                let whole =
                    |image: &Image| image.values.iter().map(|share| f32::from(u8::from(*share > WHOLE))).collect();
                let coarse = [&fine, &weight].map(|of| reduced(of, 2));
                [Reduced::new(&coarse[0], whole(&coarse[1])), Reduced::new(&fine, whole(&weight))]
            })
            .collect();
        let row = |i: usize| -> Vec<f32> {
            let [coarse_i, fine_i] = &coarse[i];
            let with = |[coarse_j, fine_j]: &[Reduced; 2]| {
                let about = coarse_i.best(coarse_j, [0, 0], REACH / 2).1;
                fine_i.best(fine_j, about.map(|d| 2 * d), 1).0
            };
            coarse[i + 1..].iter().map(with).collect()
        };
        Similarity((0..thin.len()).into_par_iter().map(row).collect())
    }

    /// Mean similarity of the frames of a range that are `lag` frames apart.
    fn after(&self, frames: std::ops::Range<usize>, lag: usize) -> f64 {
        let pairs: Vec<f64> = frames.clone().filter(|i| i + lag < frames.end).map(|i| self.at(i, lag)).collect();
        pairs.iter().sum::<f64>() / pairs.len().max(1) as f64
    }

    fn at(&self, i: usize, lag: usize) -> f64 {
        if lag == 0 { 1.0 } else { f64::from(self.0[i][lag - 1]) }
    }

    /// Finds the length of a beat within a range of frames taken at a rate; none where they do not return.
    pub(super) fn rhythm(&self, frames: std::ops::Range<usize>, frames_per_s: f64) -> Option<Rhythm> {
        let n = frames.len();
        let alike: Vec<f64> = (0..n.saturating_sub(2)).map(|lag| self.after(frames.clone(), lag)).collect();
        let [longest, shortest] = RATES.map(|rate| 60.0 / rate * frames_per_s);
        let longest = (longest.ceil() as usize).min((n.saturating_sub(1) as f64 / MIN_BEATS) as usize);
        let is_peak = |lag: &usize| {
            *lag > 0 && lag + 1 < alike.len() && alike[*lag] >= alike[lag - 1] && alike[*lag] >= alike[lag + 1]
        };
        let valley = |lag: usize| alike[1..lag].iter().copied().fold(f64::MAX, f64::min);
        let rise = |lag: usize| alike[lag] - valley(lag);
        let peaks: Vec<usize> = ((shortest as usize).max(2)..=longest).filter(is_peak).collect();
        let best = peaks.iter().map(|lag| rise(*lag)).fold(0.0, f64::max);
        let first = peaks.into_iter().find(|lag| rise(*lag) >= AS_GOOD * best)?;
        let returns = rise(first) / (alike[1] - valley(first)).max(f64::MIN_POSITIVE);
        let at_summit =
            |lag: usize| lag as f64 + f64::from(summit([lag - 1, lag, lag + 1].map(|lag| alike[lag] as f32)));
        // Several beats determine the length of one more precisely.
        let mut length = at_summit(first);
        for beats in 2..=MAX_BEATS {
            let about = (beats as f64 * length).round() as usize;
            let lags = (about - 1..=about + 1).filter(|lag| *lag < alike.len());
            let Some(lag) = lags.max_by(|a, b| alike[*a].total_cmp(&alike[*b])) else { break };
            if 4 * lag > 3 * n || !is_peak(&lag) {
                break;
            }
            length = at_summit(lag) / beats as f64;
        }
        (returns >= MIN_RETURN).then_some(Rhythm { frames: length, returns })
    }
}

/// A reduced image without its mean; 0 where it does not show the patient.
struct Reduced {
    image: Image,
    norm: f32,
}

impl Reduced {
    fn new(image: &Image, weights: Vec<f32>) -> Reduced {
        let sum: f32 = image.values.iter().zip(&weights).map(|(v, w)| v * w).sum();
        let mean = sum / weights.iter().sum::<f32>().max(1.0);
        let image = Image { values: image.values.iter().zip(weights).map(|(v, w)| w * (v - mean)).collect(), ..*image };
        let norm = image.values.iter().map(|v| v * v).sum::<f32>().sqrt();
        Reduced { image, norm }
    }

    /// Highest correlation with another image at displacements around `centre`, and the displacement.
    fn best(&self, other: &Reduced, centre: [i32; 2], reach: i32) -> (f32, [i32; 2]) {
        let around = (-reach..=reach).flat_map(|y| (-reach..=reach).map(move |x| [centre[0] + x, centre[1] + y]));
        let rated = around.map(|d| (self.product(other, d) / (self.norm * other.norm).max(f32::MIN_POSITIVE), d));
        rated.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, centre))
    }

    fn product(&self, other: &Reduced, [dx, dy]: [i32; 2]) -> f32 {
        let (width, height) = (self.image.width, self.image.height);
        let overlap = |d: i32, n: usize| (d.max(0) as usize, n.saturating_sub(d.unsigned_abs() as usize));
        let ((x, columns), (y, rows)) = (overlap(dx, width), overlap(dy, height));
        let of_row = |row: usize| {
            let here = (y + row) * width + x;
            let there = (y + row).wrapping_add_signed(-dy as isize) * width + x.wrapping_add_signed(-dx as isize);
            product(&self.image.values[here..here + columns], &other.image.values[there..there + columns])
        };
        (0..rows).map(of_row).sum()
    }
}
