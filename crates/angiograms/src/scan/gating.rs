//! Cardiac phases from time stamps and R-peaks.

use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};
use strum::{IntoStaticStr, VariantArray};

/// Time from the R-peak to the end of systole, seconds. Coronary arteries are at rest 280 to 340 ms after R at heart rates of
/// 60 to 80 per minute.
pub const SYSTOLE_S: f64 = 0.31;
/// Share of the phases before the end of systole. Phases are fractions of a beat of [`SYSTOLE_S`] / 0.35, that is 68 beats per
/// minute.
pub const SYSTOLE_SHARE: f64 = 0.35;
/// Longest systole as a share of the beat, because fast hearts also shorten systole.
const LONGEST_SYSTOLE: f64 = 0.6;

/// Conversion of the time since the R-peak to a fraction of the beat, for different heart rates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum BeatScaling {
    /// The whole beat is stretched uniformly.
    Linear,
    /// Systole keeps its length ([`SYSTOLE_S`]); diastole fills the rest of the beat.
    #[default]
    TwoSegment,
}

impl BeatScaling {
    /// Fraction of the beat (0 to 1) at a time after the R-peak, for a beat of length `beat_s`, both in seconds.
    pub fn fraction(self, since_r_s: f64, beat_s: f64) -> f64 {
        match self {
            BeatScaling::Linear => (since_r_s / beat_s).clamp(0.0, 1.0),
            BeatScaling::TwoSegment => two_segment_fraction(since_r_s, beat_s, SYSTOLE_S),
        }
    }
}

/// Fraction of the beat (0 to 1) at a time after the R-peak, seconds, in a beat whose systole ends after `systole_s`: linear
/// within systole, which covers the first [`SYSTOLE_SHARE`], and linear within diastole, which covers the rest.
pub fn two_segment_fraction(since_r_s: f64, beat_s: f64, systole_s: f64) -> f64 {
    let systole_s = systole_s.min(LONGEST_SYSTOLE * beat_s);
    let fraction = if since_r_s < systole_s {
        SYSTOLE_SHARE * since_r_s / systole_s
    } else {
        SYSTOLE_SHARE + (1.0 - SYSTOLE_SHARE) * (since_r_s - systole_s) / (beat_s - systole_s)
    };
    fraction.clamp(0.0, 1.0)
}

/// Contraction of the ventricle at a fraction of the beat: 0 at end-diastole, 1 at end-systole ([`SYSTOLE_SHARE`] of the beat),
/// 0 again from 75 % of the beat to its end.
pub fn contraction(fraction: f64) -> f64 {
    let x = fraction.rem_euclid(1.0);
    let since_systole = x - SYSTOLE_SHARE;
    let half_wave =
        if since_systole < 0.0 { 0.5 * x / SYSTOLE_SHARE } else { (0.5 + 0.5 * since_systole / 0.4).min(1.0) };
    (std::f64::consts::PI * half_wave).sin().powi(2)
}

/// Time in the beat: at a phase, or between two phases.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BeatTime {
    /// Nearest phase, from 0.
    pub phase: u32,
    /// Time after that phase, in phases: from -0.5 to 0.5.
    pub after_phase: f64,
}

/// Resolution of times in phases. Smaller differences are below the accuracy of clocks, and sums of times have rounding errors.
const SAME_TIME_PHASES: f64 = 1e-6;

impl BeatTime {
    fn new(phase: u32, after_phase: f64) -> BeatTime {
        BeatTime { phase, after_phase: (after_phase / SAME_TIME_PHASES).round() * SAME_TIME_PHASES }
    }

    /// Time exactly at a phase.
    pub fn at_phase(phase: u32) -> BeatTime {
        BeatTime { phase, after_phase: 0.0 }
    }

    /// Converts a time counted in phases; a beat has `n_phases` of them and is cyclic.
    pub fn of(time_phases: f64, n_phases: u32) -> BeatTime {
        let nearest = time_phases.round();
        let phase = nearest.rem_euclid(f64::from(n_phases)) as u32;
        BeatTime::new(phase, time_phases - nearest)
    }

    /// Phase on the other side of this time, in a cyclic beat of `n_phases`.
    pub fn beyond(self, n_phases: u32) -> u32 {
        let step = if self.after_phase < 0.0 { n_phases - 1 } else { 1 };
        (self.phase + step) % n_phases
    }

    /// The two phases around this time, the nearest first, each with its share in an image taken at this time.
    pub fn shown(self, n_phases: u32) -> [(usize, f64); 2] {
        let share = self.after_phase.abs();
        [(self.phase as usize, 1.0 - share), (self.beyond(n_phases) as usize, share)]
    }

    /// Time counted in phases, from 0 to below `n_phases`.
    pub fn phases(self, n_phases: u32) -> f64 {
        let beat = f64::from(n_phases);
        let time = (f64::from(self.phase) + self.after_phase).rem_euclid(beat);
        // Just before phase 0, rounding can give a whole beat as the remainder.
        if time < beat { time } else { 0.0 }
    }
}

/// Longest beat as a multiple of the median beat; longer intervals are gaps in the ECG.
const LONGEST_BEAT: f64 = 1.8;

/// R-peaks of a run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RPeaks {
    times_s: Vec<f64>,
}

/// Refuses a heart rate that no patient has, beats per minute.
fn check_rate(beats_per_min: f64, field: &'static str) -> Result<()> {
    if (20.0..=300.0).contains(&beats_per_min) {
        return Ok(());
    }
    let problem = "beats per minute are not in the accepted range, 20 to 300";
    Err(Error::config(field, (100.0 * beats_per_min).round() / 100.0, problem))
}

impl RPeaks {
    /// Makes R-peaks from increasing times, seconds.
    ///
    /// # Errors
    /// [`Error::Config`] for fewer than two times, for times that are not finite or do not increase, and for a median rate outside 20 to 300
    /// beats per minute.
    pub fn new(times_s: &[f64]) -> Result<RPeaks> {
        if times_s.len() < 2 {
            return Err(Error::config("r_peaks", times_s.len(), "R-peaks are given, but at least two are needed"));
        }
        if let Some(bad) = times_s.iter().find(|t| !t.is_finite()) {
            return Err(Error::config("r_peaks", bad, "is not a time in seconds"));
        }
        if let Some(w) = times_s.windows(2).find(|w| w[1] <= w[0]) {
            return Err(Error::config("r_peaks", w[1], format!("is not after {}: times must increase", w[0])));
        }
        let peaks = RPeaks { times_s: times_s.to_vec() };
        check_rate(60.0 / peaks.beat_s(), "r_peaks")?;
        Ok(peaks)
    }

    /// Makes R-peaks of a steady heart from `start_s` until they cover `end_s`.
    ///
    /// # Errors
    /// [`Error::Config`] for a rate outside 20 to 300 beats per minute.
    pub fn steady(beats_per_min: f64, start_s: f64, end_s: f64) -> Result<RPeaks> {
        check_rate(beats_per_min, "heart rate")?;
        let beat = 60.0 / beats_per_min;
        let n = ((end_s - start_s).max(0.0) / beat).floor() as usize + 2;
        Self::new(&(0..n).map(|i| start_s + i as f64 * beat).collect::<Vec<_>>())
    }

    /// Times of the R-peaks, seconds.
    pub fn times_s(&self) -> &[f64] {
        &self.times_s
    }

    /// Median length of a beat, seconds.
    pub fn beat_s(&self) -> f64 {
        let mut beats: Vec<f64> = self.times_s.windows(2).map(|w| w[1] - w[0]).collect();
        beats.sort_by(f64::total_cmp);
        beats[beats.len() / 2]
    }

    /// Time in the beat at a time in seconds: the phase, from 0, is one of `n_phases` equal parts of the beat as scaled by
    /// `scaling`, and the time after the phase is counted from the middle of that part. Covers up to one median beat before the
    /// first and after the last R-peak; `None` outside this range and within gaps of the ECG.
    pub fn beat_time(&self, time_s: f64, n_phases: u32, scaling: BeatScaling) -> Option<BeatTime> {
        let usual = self.beat_s();
        let after = self.times_s.partition_point(|r| *r <= time_s);
        let (start, beat) = match (after, self.times_s.len()) {
            (0, _) => (self.times_s[0] - usual, usual),
            (i, n) if i == n => (self.times_s[n - 1], usual),
            (i, _) => (self.times_s[i - 1], self.times_s[i] - self.times_s[i - 1]),
        };
        let since_r_s = time_s - start;
        if !(0.0..beat).contains(&since_r_s) || beat > LONGEST_BEAT * usual {
            return None;
        }
        let parts = scaling.fraction(since_r_s, beat) * f64::from(n_phases);
        let phase = (parts as u32).min(n_phases - 1);
        Some(BeatTime::new(phase, parts - f64::from(phase) - 0.5))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use BeatScaling::Linear;

    /// Phase out of ten phases.
    fn phase(peaks: &RPeaks, time_s: f64, scaling: BeatScaling) -> Option<u32> {
        peaks.beat_time(time_s, 10, scaling).map(|found| found.phase)
    }

    #[test]
    fn phases_are_equal_parts_of_each_beat() {
        let peaks = RPeaks::new(&[1.0, 2.0, 2.8]).unwrap();
        let phase = |time_s| phase(&peaks, time_s, Linear);
        assert_eq!(phase(1.0), Some(0));
        assert_eq!(phase(1.55), Some(5));
        assert_eq!(phase(2.4), Some(5), "a shorter beat has shorter phases");
        assert_eq!(phase(0.5), Some(5), "one beat before the first R-peak is known well enough");
        assert_eq!(phase(3.5), Some(7), "and one after the last");
        assert_eq!((phase(-0.1), phase(4.0)), (None, None));
    }

    #[test]
    fn frames_keep_their_own_time_within_a_phase() {
        let peaks = RPeaks::new(&[1.0, 2.0, 3.0]).unwrap();
        for (time_s, after) in [(1.50, -0.5), (1.55, 0.0), (1.58, 0.3), (2.51, -0.4)] {
            let found = peaks.beat_time(time_s, 10, Linear).unwrap();
            assert_eq!(found.phase, 5);
            assert!((found.after_phase - after).abs() < 1e-9, "{time_s} s: {found:?}");
        }
        let late = BeatTime::of(9.7, 10);
        assert_eq!(late.phase, 0, "the beat closes");
        assert!((late.after_phase + 0.3).abs() < 1e-12 && (late.phases(10) - 9.7).abs() < 1e-12);
        assert_eq!(BeatTime::of(4.0, 10), BeatTime::at_phase(4));
    }

    #[test]
    fn a_slow_beat_is_slow_in_diastole() {
        let peaks = RPeaks::new(&[0.0, 1.5, 3.0]).unwrap();
        let at = |time_s| (phase(&peaks, time_s, Linear), phase(&peaks, time_s, BeatScaling::TwoSegment));
        assert_eq!(at(0.305), (Some(2), Some(3)), "the end of systole");
        assert_eq!(at(1.49), (Some(9), Some(9)), "the end of the beat");
    }

    #[test]
    fn a_gap_in_the_ecg_has_no_phase() {
        let peaks = RPeaks::new(&[0.0, 1.0, 2.0, 5.0, 6.0]).unwrap();
        assert_eq!(phase(&peaks, 3.0, Linear), None);
        assert_eq!(phase(&peaks, 5.5, Linear), Some(5));
    }

    #[test]
    fn systole_keeps_its_length_and_diastole_takes_the_rest() {
        let at = |since_r_s, beat_s| BeatScaling::TwoSegment.fraction(since_r_s, beat_s);
        for beat_s in [0.75, 1.0, 1.3] {
            assert!((at(SYSTOLE_S, beat_s) - SYSTOLE_SHARE).abs() < 1e-12, "end of systole in a beat of {beat_s} s");
            assert!((at(0.5 * (SYSTOLE_S + beat_s), beat_s) - 0.675).abs() < 1e-12, "middle of diastole");
            assert!(at(0.0, beat_s) == 0.0 && (at(beat_s, beat_s) - 1.0).abs() < 1e-12, "both ends of the beat");
        }
        assert!((at(0.18, 0.3) - SYSTOLE_SHARE).abs() < 1e-12, "systole leaves room for diastole");
        assert_eq!(BeatScaling::Linear.fraction(0.25, 1.0), 0.25);
        let usual = SYSTOLE_S / SYSTOLE_SHARE;
        assert!(
            (at(0.6, usual) - BeatScaling::Linear.fraction(0.6, usual)).abs() < 1e-12,
            "both agree at 68 per minute"
        );
    }

    #[test]
    fn r_peaks_must_rise() {
        assert!(RPeaks::new(&[1.0]).is_err());
        assert!(RPeaks::new(&[1.0, 1.0]).unwrap_err().to_string().contains("must increase"));
        assert!(RPeaks::new(&[1.0, f64::NAN]).is_err());
        assert_eq!(phase(&RPeaks::steady(60.0, 0.5, 3.0).unwrap(), 1.75, Linear), Some(2));
    }
}
