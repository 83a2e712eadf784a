//! Times of the images of each view, with the state of heart, breath and contrast at each time.

use crate::degradations::{Breathing, Chance, Degradations, Draw, Rhythm};
use crate::scan::dataset::Split;
use crate::scan::gating::{BeatTime, two_segment_fraction};
use crate::voxels::Breath;
use glam::DVec3;

/// Length of a beat without a stated heart rate, seconds; phases divide it equally.
pub(super) const USUAL_BEAT_S: f64 = 1.0;
/// Displacement of the heart during expiration, per mm along the body, LPS: up and back. Shechter et al., "Respiratory motion
/// of the heart from free breathing coronary angiograms", IEEE Trans. Med. Imaging 23:1046 (2004): 4.9 mm down and 1.3 mm to
/// the front during inspiration.
const BREATH: DVec3 = DVec3::new(0.0, 1.3 / 4.9, 1.0);
/// End of systole after the R-peak, seconds, with its range between runs: the time of rest that Shechter and others find.
pub(super) const SYSTOLE_S: std::ops::Range<f64> = 0.28..0.34;
/// Period of the variation of contrast within a run, seconds.
const CONTRAST_WAVE_S: f64 = 3.0;
/// Variation of contrast within a run as a share of its variation between runs.
const CONTRAST_WITHIN: f64 = 0.5;
/// Lower bound of the factor on the vessels' contrast.
const MIN_CONTRAST: f64 = 0.1;

/// An image to be taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Shot {
    /// Time in the beat that the dataset states.
    pub(super) stated: BeatTime,
    /// Time since the first image of the run, seconds.
    pub(super) time_s: f64,
    /// True fraction of the beat, 0 to 1.
    pub(super) fraction: f64,
    pub(super) breath: Breath,
    /// Factor on the vessels' contrast.
    pub(super) contrast_gain: f64,
    /// Share of the way to the farthest end of the vessels that contrast has reached; 1 where all vessels are filled.
    pub(super) filled_to: f64,
}

impl Shot {
    /// Makes a shot exactly at a phase, in held breath.
    pub(super) fn at_phase(phase: u32, phases: u32) -> Shot {
        let fraction = f64::from(phase) / f64::from(phases);
        Shot::full(BeatTime::at_phase(phase), USUAL_BEAT_S * fraction, fraction)
    }

    /// Makes a shot with full vessels in held breath.
    fn full(stated: BeatTime, time_s: f64, fraction: f64) -> Shot {
        Shot { stated, time_s, fraction, breath: Breath::default(), contrast_gain: 1.0, filled_to: 1.0 }
    }
}

/// Images of a view by phase; `None` where its run has no image near enough to the phase.
pub(super) fn shots(options: &Degradations, seed: u32, view: usize, split: Split, phases: u32) -> Vec<Option<Shot>> {
    let regular = (0..phases).map(|phase| Some(Shot::at_phase(phase, phases))).collect();
    if split == Split::Validation {
        return regular;
    }
    let chance = Chance { seed, view: view as u32 };
    let mut shots = match &options.rhythm {
        Some(rhythm) => gated(rhythm, chance, phases),
        None => regular,
    };
    for shot in shots.iter_mut().flatten() {
        shot.breath = options.breathing.map_or_else(Breath::default, |breathing| breathing.at(shot.time_s, chance));
        if options.contrast_variation > 0.0 {
            shot.contrast_gain = contrast_gain(options.contrast_variation, shot.time_s, chance);
        }
        if options.inflow_s > 0.0 {
            shot.filled_to = (shot.time_s / options.inflow_s).min(1.0);
        }
    }
    shots
}

/// Selects for each phase the nearest image of a run, at most half a phase away.
fn gated(rhythm: &Rhythm, chance: Chance, phases: u32) -> Vec<Option<Shot>> {
    let rates = &rhythm.beats_per_min;
    let beat_s = 60.0 / rates[chance.view as usize % rates.len()];
    let systole_s = SYSTOLE_S.start + (SYSTOLE_S.end - SYSTOLE_S.start) * chance.uniform(Draw::Systole);
    let start_s = beat_s * chance.uniform(Draw::RunStart);
    let images = (f64::from(rhythm.beats) * beat_s * rhythm.frames_per_s).ceil() as u32;
    let mut nearest: Vec<Option<Shot>> = vec![None; phases as usize];
    for image in 0..images {
        let time_s = f64::from(image) / rhythm.frames_per_s;
        let since_r_s = (start_s + time_s).rem_euclid(beat_s);
        let stated = BeatTime::of(f64::from(phases) * rhythm.gating.fraction(since_r_s, beat_s), phases);
        let slot = &mut nearest[stated.phase as usize];
        if slot.is_none_or(|best| stated.after_phase.abs() < best.stated.after_phase.abs()) {
            let fraction = two_segment_fraction(since_r_s, beat_s, systole_s).rem_euclid(1.0);
            *slot = Some(Shot::full(stated, time_s, fraction));
        }
    }
    nearest
}

impl Breathing {
    /// Displacement by breathing at a time of a run; each run begins at a random point of the breath.
    pub(super) fn at(self, time_s: f64, chance: Chance) -> Breath {
        let course = chance.uniform(Draw::Breath) + time_s / self.period_s;
        let heart_mm = BREATH * (0.5 * self.peak_to_peak_mm * (std::f64::consts::TAU * course).sin());
        Breath { heart_mm, chest_mm: if self.background { heart_mm } else { DVec3::ZERO } }
    }
}

/// Factor on the contrast of a run, with its slow variation over time.
pub(super) fn contrast_gain(variation: f64, time_s: f64, chance: Chance) -> f64 {
    let course = chance.uniform(Draw::ContrastCourse) + time_s / CONTRAST_WAVE_S;
    let wave = std::f64::consts::SQRT_2 * (std::f64::consts::TAU * course).sin();
    let gain = 1.0 + variation * (chance.normal(Draw::Contrast) + CONTRAST_WITHIN * wave);
    gain.max(MIN_CONTRAST)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::gating::BeatScaling;

    const PHASES: u32 = 10;

    fn rhythm(rate: f64, frames_per_s: f64, beats: u32, gating: BeatScaling) -> Rhythm {
        Rhythm { beats_per_min: vec![rate], frames_per_s, beats, gating }
    }

    /// Largest distance between the true phase of an image and its assigned phase, and the number of phases with an image.
    fn phase_errors(rhythm: &Rhythm) -> (f64, usize) {
        let (mut worst, mut seen) = (0f64, 0);
        for view in 0..20 {
            for (phase, shot) in gated(rhythm, Chance { seed: 1, view }, PHASES).iter().enumerate() {
                let Some(shot) = shot else { continue };
                let off = shot.fraction * f64::from(PHASES) - phase as f64;
                let around = off - f64::from(PHASES) * (off / f64::from(PHASES)).round();
                worst = worst.max(around.abs());
                seen += 1;
            }
        }
        (worst, seen)
    }

    #[test]
    fn gating_finds_the_phases() {
        use BeatScaling::{Linear, TwoSegment};
        // Half a phase of sampling, plus the effect of 30 ms of systole: 30 / 310 of 3.5 phases.
        for rate in [50.0, 68.0, 100.0] {
            let (worst, seen) = phase_errors(&rhythm(rate, 30.0, 1, TwoSegment));
            assert!(worst < 0.9, "{rate} per minute: {worst} phases");
            assert_eq!(seen, 200, "{rate} per minute");
        }
        let slow = |gating| phase_errors(&rhythm(45.0, 1000.0, 1, gating)).0;
        assert!(slow(TwoSegment) < 0.45 && slow(Linear) > 1.0, "{} {}", slow(TwoSegment), slow(Linear));
    }

    #[test]
    fn few_images_leave_phases_out() {
        let one_beat = phase_errors(&rhythm(80.0, 7.5, 1, BeatScaling::TwoSegment)).1;
        assert!((100..=120).contains(&one_beat), "6 images a beat: {one_beat} of 200");
        assert!(phase_errors(&rhythm(80.0, 7.5, 3, BeatScaling::TwoSegment)).1 > 130);
    }

    #[test]
    fn breath_and_contrast_have_the_size_asked_for() {
        let breathing = Breathing { peak_to_peak_mm: 4.0, period_s: 5.0, background: false };
        let course: Vec<Breath> =
            (0..500).map(|i| breathing.at(0.01 * f64::from(i), Chance { seed: 1, view: 2 })).collect();
        let along: Vec<f64> = course.iter().map(|b| b.heart_mm.z).collect();
        let (low, high) = along.iter().fold((f64::MAX, f64::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
        assert!((high - low - 4.0).abs() < 0.01 && (high + low).abs() < 0.01, "{low} to {high}");
        assert!(course.iter().all(|b| b.chest_mm == DVec3::ZERO));
        let (mut between, mut within) = (0.0, 0.0);
        for view in 0..1000 {
            let gains: Vec<f64> =
                (0..30).map(|i| contrast_gain(0.1, 0.1 * f64::from(i), Chance { seed: 1, view })).collect();
            let mean = gains.iter().sum::<f64>() / 30.0;
            between += (mean - 1.0).powi(2) / 1000.0;
            within += gains.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / 30e3;
        }
        let (between, within) = (between.sqrt(), within.sqrt());
        assert!((between - 0.1).abs() < 0.01 && (within - 0.05).abs() < 0.005, "{between}, {within}");
    }
}
