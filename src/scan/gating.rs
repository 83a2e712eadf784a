//! Cardiac phases from time stamps and R-peaks.

use crate::error::{Error, Result};

/// Beats longer than this many of the usual ones are gaps in the ECG, not beats.
const LONGEST_BEAT: f64 = 1.8;

/// R-peaks of a run.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct RPeaks {
    times_s: Vec<f64>,
}

impl RPeaks {
    /// R-peaks at rising times.
    ///
    /// # Errors
    /// [`Error::Config`] for fewer than two, times that are not finite, or not rising.
    pub fn new(times_s: &[f64]) -> Result<RPeaks> {
        if times_s.len() < 2 {
            return Err(Error::config("r_peaks", times_s.len(), "at least two R-peaks bound a beat"));
        }
        if let Some(bad) = times_s.iter().find(|t| !t.is_finite()) {
            return Err(Error::config("r_peaks", bad, "is not a time in seconds"));
        }
        if let Some(w) = times_s.windows(2).find(|w| w[1] <= w[0]) {
            return Err(Error::config("r_peaks", w[1], format!("does not follow {}: times must rise", w[0])));
        }
        Ok(RPeaks { times_s: times_s.to_vec() })
    }

    /// R-peaks of a steady heart from `start_s` on, as many as cover `end_s`.
    ///
    /// # Errors
    /// [`Error::Config`] for a rate outside 20 to 300 beats per minute.
    pub fn steady(beats_per_min: f64, start_s: f64, end_s: f64) -> Result<RPeaks> {
        if !(20.0..=300.0).contains(&beats_per_min) {
            return Err(Error::config("heart rate", beats_per_min, "20 to 300 beats per minute are accepted"));
        }
        let beat = 60.0 / beats_per_min;
        let n = ((end_s - start_s).max(0.0) / beat).floor() as usize + 2;
        Self::new(&(0..n).map(|i| start_s + i as f64 * beat).collect::<Vec<_>>())
    }

    /// Median length of a beat, seconds.
    pub fn beat_s(&self) -> f64 {
        let mut beats: Vec<f64> = self.times_s.windows(2).map(|w| w[1] - w[0]).collect();
        beats.sort_by(f64::total_cmp);
        beats[beats.len() / 2]
    }

    /// Phase of a time, from 0, of `n_phases` equal parts of its beat. Up to one usual beat before the first and after
    /// the last R-peak counts; `None` beyond, and within gaps of the ECG.
    pub fn phase(&self, time_s: f64, n_phases: u32) -> Option<u32> {
        let usual = self.beat_s();
        let after = self.times_s.partition_point(|r| *r <= time_s);
        let (start, beat) = match (after, self.times_s.len()) {
            (0, _) => (self.times_s[0] - usual, usual),
            (i, n) if i == n => (self.times_s[n - 1], usual),
            (i, _) => (self.times_s[i - 1], self.times_s[i] - self.times_s[i - 1]),
        };
        let share = (time_s - start) / beat;
        if !(0.0..1.0).contains(&share) || beat > LONGEST_BEAT * usual {
            return None;
        }
        Some(((share * f64::from(n_phases)) as u32).min(n_phases - 1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn phases_are_equal_parts_of_each_beat() {
        let peaks = RPeaks::new(&[1.0, 2.0, 2.8]).unwrap();
        assert_eq!(peaks.phase(1.0, 10), Some(0));
        assert_eq!(peaks.phase(1.55, 10), Some(5));
        assert_eq!(peaks.phase(2.4, 10), Some(5), "a shorter beat has shorter phases");
        assert_eq!(peaks.phase(0.5, 10), Some(5), "one beat before the first R-peak is known well enough");
        assert_eq!(peaks.phase(3.5, 10), Some(7), "and one after the last");
        assert_eq!((peaks.phase(-0.1, 10), peaks.phase(4.0, 10)), (None, None));
    }

    #[test]
    fn a_gap_in_the_ecg_has_no_phase() {
        let peaks = RPeaks::new(&[0.0, 1.0, 2.0, 5.0, 6.0]).unwrap();
        assert_eq!(peaks.phase(3.0, 10), None);
        assert_eq!(peaks.phase(5.5, 10), Some(5));
    }

    #[test]
    fn r_peaks_must_rise() {
        assert!(RPeaks::new(&[1.0]).is_err());
        assert!(RPeaks::new(&[1.0, 1.0]).unwrap_err().to_string().contains("must rise"));
        assert!(RPeaks::new(&[1.0, f64::NAN]).is_err());
        assert_eq!(RPeaks::steady(60.0, 0.5, 3.0).unwrap().phase(1.75, 4), Some(1));
    }
}
