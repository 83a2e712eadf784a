//! Choice among the beats of a run: frames of one phase from two beats show each vessel twice where the patient breathes.

use crate::raster::{Image, opening, percentile};
use crate::scan::gating::{BeatTime, RPeaks};
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Percentile of the contrast of thin structures that stands for a frame.
const CONTRAST_PERCENTILE: f64 = 0.98;

/// Longest side of the reduced images, pixels.
const SIDE: usize = 64;

/// A selected frame of a run, with its place in the rhythm.
pub(super) struct Beating<'a> {
    /// Line integrals.
    pub image: &'a Image,
    /// Time of the frame, seconds; its place in the order of frames where times are not known.
    pub time_s: f64,
    /// Time in the beat; none for a frame that no beat covers.
    pub taken: Option<BeatTime>,
    /// Number of the beat, from 0.
    pub beat: usize,
}

/// Numbers of the beats at times in seconds; the first is 0 for frames before the first R-peak.
pub(super) fn numbers(times_s: &[f64], peaks: &RPeaks) -> Vec<usize> {
    times_s.iter().map(|time| peaks.times_s().partition_point(|peak| peak <= time)).collect()
}

/// Numbers of the beats of listed phases: a phase that is earlier than the one before begins a beat.
pub(super) fn numbers_of_list(phases: &[f64]) -> Vec<usize> {
    let mut beat = 0;
    let begins = phases.windows(2).map(|pair| usize::from(pair[1] < pair[0]));
    std::iter::once(0)
        .chain(begins)
        .take(phases.len())
        .map(|begins| {
            beat += begins;
            beat
        })
        .collect()
}

/// A beat and its rating.
struct Rated {
    beat: usize,
    phases: BTreeSet<u32>,
    /// Contrast of the vessels as a share of that of the best beat.
    contrast: f64,
    /// Difference between images of a phase in this beat and in its neighbours, 0 (none) to 1.
    change: f64,
}

impl Rated {
    fn score(&self) -> f64 {
        self.phases.len() as f64 * self.contrast * (1.0 - self.change).max(0.0)
    }
}

/// For each frame, whether it is used: each phase is taken from one beat, which is the best one that shows the phase. The best
/// beats show many phases, have much contrast, and change little to the next beat. Returns a note where there is a choice.
pub(super) fn choose(frames: &[Beating<'_>], vessel: usize) -> (Vec<bool>, Option<String>) {
    let known = |frame: &&Beating<'_>| frame.taken.is_some();
    let beats: BTreeSet<usize> = frames.iter().filter(known).map(|frame| frame.beat).collect();
    if beats.len() < 2 {
        return (vec![true; frames.len()], None);
    }
    let contrast: Vec<f64> = frames.par_iter().map(|frame| contrast(frame.image, vessel)).collect();
    let maps: Vec<Vec<f32>> = frames.par_iter().map(|frame| vessels(frame.image, vessel)).collect();
    let mut rated: Vec<Rated> = beats.iter().map(|beat| rate(*beat, frames, &contrast, &maps)).collect();
    let most = rated.iter().map(|beat| beat.contrast).fold(f64::MIN_POSITIVE, f64::max);
    rated.iter_mut().for_each(|beat| beat.contrast /= most);
    rated.sort_by(|a, b| b.score().total_cmp(&a.score()));
    let best_of = |phase: u32| rated.iter().find(|beat| beat.phases.contains(&phase)).map(|beat| beat.beat);
    let used = frames.iter().map(|frame| frame.taken.is_some_and(|t| best_of(t.phase) == Some(frame.beat)));
    let used: Vec<bool> = used.collect();
    let note = note(&rated, &beats, frames);
    (used, Some(note))
}

fn note(rated: &[Rated], beats: &BTreeSet<usize>, frames: &[Beating<'_>]) -> String {
    let best = &rated[0];
    let place = beats.iter().position(|beat| *beat == best.beat).unwrap_or(0) + 1;
    let times = frames.iter().filter(|frame| frame.beat == best.beat).map(|frame| frame.time_s);
    let (first, last) = times.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), t| (a.min(t), b.max(t)));
    let elsewhere: BTreeSet<u32> =
        rated.iter().flat_map(|beat| &beat.phases).copied().filter(|phase| !best.phases.contains(phase)).collect();
    let rest = match elsewhere.len() {
        0 => String::new(),
        n => format!("; {n} phases that it does not show are taken from other beats"),
    };
    format!(
        "beat {place} of {} ({first:.2} to {last:.2} s) is used: it has {:.0} % of the strongest contrast, and differs from its \
         neighbours by {:.0} %{rest}; --all-beats averages the beats",
        beats.len(),
        100.0 * best.contrast,
        100.0 * best.change
    )
}

fn rate(beat: usize, frames: &[Beating<'_>], contrast: &[f64], maps: &[Vec<f32>]) -> Rated {
    let phase = |i: usize| frames[i].taken.map(|taken| taken.phase);
    let own: Vec<usize> = (0..frames.len()).filter(|i| frames[*i].beat == beat && phase(*i).is_some()).collect();
    let mean = |values: Vec<f64>| values.iter().sum::<f64>() / values.len().max(1) as f64;
    let beside = |i: usize| {
        let others = (0..frames.len()).filter(move |j| frames[*j].beat.abs_diff(beat) == 1 && phase(*j) == phase(i));
        others.map(move |j| difference(&maps[i], &maps[j]))
    };
    Rated {
        beat,
        phases: own.iter().filter_map(|i| phase(*i)).collect(),
        contrast: mean(own.iter().map(|i| contrast[*i]).collect()),
        change: mean(own.iter().flat_map(|i| beside(*i)).collect()),
    }
}

/// Extracts thin structures, such as vessels, on a coarser pixel grid and divides them by their sum, so that the amount of
/// contrast has no effect.
fn vessels(image: &Image, vessel_pixels: usize) -> Vec<f32> {
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

/// Contrast of thin dark structures.
pub(super) fn contrast(image: &Image, vessel: usize) -> f64 {
    let background = opening(image, vessel).values;
    let stand_out: Vec<f32> = image.values.iter().zip(&background).map(|(v, b)| (v - b).max(0.0)).collect();
    f64::from(percentile(&stand_out, CONTRAST_PERCENTILE))
}

/// Difference of two maps of vessels: 0 for equal ones, 1 for those without anything in common.
fn difference(a: &[f32], b: &[f32]) -> f64 {
    let product = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum::<f64>();
    let norm = (product(a, a) * product(b, b)).sqrt();
    if norm > 0.0 { (1.0 - product(a, b) / norm).clamp(0.0, 1.0) } else { 1.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: usize = 32;

    /// A vertical vessel of some contrast at a column.
    fn image(column: f64, contrast: f64) -> Image {
        let value = |p: usize| contrast * (-((p % SIZE) as f64 - column).powi(2) / 2.0).exp();
        Image { width: SIZE, height: SIZE, values: (0..SIZE * SIZE).map(|p| value(p) as f32).collect() }
    }

    /// Which frames of two phases are used: for each beat, its column, contrast and phases.
    fn used(beats: &[(f64, f64, &[u32])]) -> Vec<(usize, u32)> {
        let images: Vec<(usize, u32, Image)> = beats
            .iter()
            .enumerate()
            .flat_map(|(beat, (column, contrast, phases))| {
                phases.iter().map(move |phase| (beat, *phase, image(column + 4.0 * f64::from(*phase), *contrast)))
            })
            .collect();
        let frames: Vec<Beating<'_>> = images
            .iter()
            .enumerate()
            .map(|(i, (beat, phase, image))| Beating {
                image,
                time_s: i as f64,
                taken: Some(BeatTime::at_phase(*phase)),
                beat: *beat,
            })
            .collect();
        let (used, note) = choose(&frames, 3);
        assert_eq!(note.is_some(), beats.len() > 1);
        images.iter().zip(used).filter(|(_, used)| *used).map(|((beat, phase, _), _)| (*beat, *phase)).collect()
    }

    #[test]
    fn each_phase_is_taken_from_the_best_beat_that_shows_it() {
        assert_eq!(used(&[(10.0, 1.0, &[0, 1])]), [(0, 0), (0, 1)], "there is no choice");
        let contrast = used(&[(10.0, 0.5, &[0, 1]), (10.0, 1.0, &[0, 1]), (10.0, 0.8, &[0, 1])]);
        assert_eq!(contrast, [(1, 0), (1, 1)], "most contrast");
        let breath = used(&[(10.0, 1.0, &[0, 1]), (10.2, 1.0, &[0, 1]), (14.0, 1.0, &[0, 1])]);
        assert_eq!(breath, [(0, 0), (0, 1)], "least breath");
        let phases = used(&[(10.0, 1.0, &[0]), (10.0, 0.9, &[0, 1]), (10.0, 0.7, &[2])]);
        assert_eq!(phases, [(1, 0), (1, 1), (2, 2)], "most phases, and the others from elsewhere");
    }

    #[test]
    fn a_list_begins_a_beat_where_its_phases_fall() {
        assert_eq!(numbers_of_list(&[1.0, 2.5, 3.0, 0.5, 1.0, 0.0]), [0, 0, 0, 1, 1, 2]);
        assert_eq!(numbers_of_list(&[]), [0; 0]);
    }
}
