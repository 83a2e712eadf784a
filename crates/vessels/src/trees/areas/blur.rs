//! Blur along vessels.

/// Lower bound of an area without the blur, as a share of the measured one.
const MIN_AREA: f64 = 0.5;

/// Takes a Gaussian blur along a vessel out of areas at regular steps, to second order: A - sigma^2 / 2 A''. The standard deviation of the blur
/// at each place is a number of steps.
pub(in crate::trees) fn without_blur(areas: &[f64], deviation_steps: &[f64]) -> Vec<f64> {
    let last = areas.len().saturating_sub(1);
    let at = |i: usize| {
        let bend = areas[i.saturating_sub(1)] - 2.0 * areas[i] + areas[(i + 1).min(last)];
        (areas[i] - 0.5 * deviation_steps[i].powi(2) * bend).max(MIN_AREA * areas[i])
    };
    (0..areas.len()).map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    #[test]
    fn a_blur_along_the_vessel_is_taken_out() {
        // A stenosis of 60 % and 12 steps.
        let radius = |i: i32| {
            let away = (f64::from(i) - 40.0) / 12.5;
            if away.abs() < 0.5 { 1.0 - 0.3 * (1.0 + (TAU * away).cos()) } else { 1.0 }
        };
        let area = |i: i32| radius(i).powi(2);
        // Standard deviation of the kernel 1, 2, 1 in steps.
        let deviation = 0.5f64.sqrt();
        let blurred: Vec<f64> = (0..80).map(|i| 0.25 * area(i - 1) + 0.5 * area(i) + 0.25 * area(i + 1)).collect();
        let sharp = without_blur(&blurred, &[deviation; 80]);
        let off = |areas: &[f64]| (0..80).map(|i| (areas[i].sqrt() - radius(i as i32)).abs()).fold(0.0, f64::max);
        assert!(off(&sharp) < 0.35 * off(&blurred), "{} of {}", off(&sharp), off(&blurred));
    }

    #[test]
    fn an_area_keeps_at_least_half() {
        assert_eq!(without_blur(&[1.0, 0.1, 1.0], &[3.0; 3])[1], 0.05);
        assert_eq!(without_blur(&[2.0], &[3.0]), [2.0]);
        assert!(without_blur(&[], &[]).is_empty());
    }
}
