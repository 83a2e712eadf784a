//! The noise of pixels, and the bias of a minimum of noisy values.

use crate::raster::median;

/// Noise of the median pixel, as a share of the strongest change, from which on images are noisy: a fit explains much of the noise, and thin
/// vessels are lost. 1e5 photons give 0.10, 2e4 photons 0.22.
pub const NOISY: f32 = 0.15;

/// Mean distance of the minimum of `n` standard normal draws below their expected value.
pub fn expected_minimum(n: usize) -> f64 {
    // Blom's approximation of the first normal order statistic.
    if n < 2 {
        return 0.0;
    }
    let p = (1.0 - 0.375) / (n as f64 + 0.25);
    // Inverse of the normal tail by bisection.
    let (mut low, mut high) = (0.0, 8.0);
    for _ in 0..60 {
        let mid = 0.5 * (low + high);
        if upper_tail(mid) > p { low = mid } else { high = mid }
    }
    0.5 * (low + high)
}

/// P(X > z) of a standard normal (Abramowitz and Stegun 26.2.17, error below 7.5e-8).
fn upper_tail(z: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.231_641_9 * z);
    let poly =
        t * (0.319_381_530 + t * (-0.356_563_782 + t * (1.781_477_937 + t * (-1.821_255_978 + t * 1.330_274_429))));
    (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt() * poly
}

/// Noise of each pixel. Successive phases of a static pixel differ by noise alone, and noise depends on intensity; so
/// pixels are grouped by intensity, and each group's median temporal deviation is its noise. A group that consists of
/// moving vessels, as the darkest one of an image with a plain background does, would present them as noise; so the noise
/// of a group is at most a few times that of the whole image.
pub fn noise_by_intensity(mean: &[f32], deviation: &[f32]) -> Vec<f32> {
    const GROUPS: usize = 24;
    const NOISIEST: f32 = 6.0;
    let max = NOISIEST * median(&mut deviation.to_vec());
    let mut order: Vec<u32> = (0..mean.len() as u32).collect();
    order.sort_unstable_by(|a, b| mean[*a as usize].total_cmp(&mean[*b as usize]));
    let mut noise = vec![0.0; mean.len()];
    for group in order.chunks(mean.len().div_ceil(GROUPS)) {
        let level = median(&mut group.iter().map(|i| deviation[*i as usize]).collect::<Vec<_>>());
        for i in group {
            noise[*i as usize] = level.min(max);
        }
    }
    noise
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn expected_minimum_of_ten_normals() {
        assert!((expected_minimum(10) - 1.5388).abs() < 0.01, "{}", expected_minimum(10));
        assert_eq!(expected_minimum(1), 0.0);
    }

    #[test]
    fn moving_vessels_are_not_taken_for_noise() {
        // The brightest tenth moves; all other pixels are static, with noise of 0.01.
        let mean: Vec<f32> = (0..1000).map(|i| i as f32).collect();
        let deviation: Vec<f32> = (0..1000).map(|i| if i >= 900 { 0.5 } else { 0.01 }).collect();
        let noise = noise_by_intensity(&mean, &deviation);
        assert!((noise[0] - 0.01).abs() < 1e-6 && noise[999] <= 0.06 + 1e-6, "{}", noise[999]);
    }
}
