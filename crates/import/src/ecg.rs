//! Finds R-peaks in an ECG trace (after Pan and Tompkins: derivative, square, moving mean, threshold).

use crate::error::{Error, Result};
use crate::scan::gating::RPeaks;

/// Shortest possible beat, seconds. It is that of 200 beats per minute.
const SHORTEST_BEAT_S: f64 = 0.3;
/// Width of a QRS complex, seconds. It is the upper limit of a normal one.
const QRS_S: f64 = 0.12;

/// Returns the R-peaks of a trace with `rate_hz` samples per second, whose first sample is at time 0.
///
/// # Errors
/// [`Error::Config`] for an unusable trace, or one with fewer than two R-peaks.
pub fn r_peaks(trace: &[f64], rate_hz: f64) -> Result<RPeaks> {
    RPeaks::new(&peak_times_s(trace, rate_hz)?)
}

/// Returns the times of the R-peaks of a trace with `rate_hz` samples per second, in seconds after its first sample.
///
/// # Errors
/// [`Error::Config`] for an unusable trace.
pub(super) fn peak_times_s(trace: &[f64], rate_hz: f64) -> Result<Vec<f64>> {
    if !(rate_hz.is_finite() && (20.0..=20_000.0).contains(&rate_hz)) {
        return Err(Error::config("ECG", rate_hz, "is not in the accepted range, 20 to 20000 samples per second"));
    }
    if trace.len() < (2.0 * SHORTEST_BEAT_S * rate_hz) as usize || trace.iter().any(|v| !v.is_finite()) {
        return Err(Error::config("ECG", trace.len(), "samples do not cover two beats, or are not all finite"));
    }
    let slope: Vec<f64> = trace.windows(2).map(|w| (w[1] - w[0]).powi(2)).collect();
    let half = ((0.5 * QRS_S * rate_hz) as usize).max(1);
    let mut sums = vec![0.0];
    slope.iter().for_each(|s| sums.push(sums[sums.len() - 1] + s));
    let energy: Vec<f64> =
        (0..slope.len()).map(|i| sums[(i + half + 1).min(slope.len())] - sums[i.saturating_sub(half)]).collect();
    let mut sorted = energy.clone();
    sorted.sort_by(f64::total_cmp);
    // QRS complexes fill about a tenth of a beat, so the 98th percentile lies within them.
    let threshold = 0.3 * sorted[sorted.len() * 98 / 100];
    let mut times: Vec<f64> = Vec::new();
    let mut i = 0;
    while i < energy.len() {
        if energy[i] <= threshold {
            i += 1;
            continue;
        }
        let end = (i..energy.len()).find(|j| energy[*j] <= threshold).unwrap_or(energy.len());
        let part = &trace[i..=end.min(trace.len() - 1)];
        let mean = trace[i.saturating_sub(4 * half)..(end + 4 * half).min(trace.len())].iter().sum::<f64>()
            / ((end + 4 * half).min(trace.len()) - i.saturating_sub(4 * half)) as f64;
        // Largest deviation from the mean in either direction, because leads differ in polarity.
        let peak = (0..part.len()).max_by(|a, b| (part[*a] - mean).abs().total_cmp(&(part[*b] - mean).abs()));
        let time = (i + peak.unwrap_or(0)) as f64 / rate_hz;
        if times.last().is_none_or(|last| time - last >= SHORTEST_BEAT_S) {
            times.push(time);
        }
        i = end + 1;
    }
    Ok(times)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scan::gating::BeatScaling;

    #[test]
    fn peaks_of_a_noisy_trace_are_found() {
        let (rate, beats) = (250.0, [0.42, 1.23, 2.11, 2.95]);
        let trace: Vec<f64> = (0..900)
            .map(|i| {
                let t = f64::from(i) / rate;
                let bump = |at: f64, width: f64, height: f64| height * (-((t - at) / width).powi(2)).exp();
                let beat: f64 = beats.iter().map(|b| bump(*b, 0.012, 1.0) + bump(b + 0.28, 0.05, 0.25)).sum();
                beat + 0.3 * (0.6 * t).sin() + 0.02 * (f64::from(i * 7919 % 101) / 50.0 - 1.0)
            })
            .collect();
        let found = r_peaks(&trace, rate).unwrap();
        let phase = |time_s| found.beat_time(time_s, 20, BeatScaling::Linear).map(|taken| taken.phase);
        for (index, beat) in beats.iter().enumerate() {
            assert_eq!(phase(beat + 0.02), Some(0), "beat {index}");
            assert_eq!(phase(beat - 0.02), Some(19), "beat {index}");
        }
        assert!(r_peaks(&[0.0; 600], rate).is_err(), "a flat line has none");
    }
}
