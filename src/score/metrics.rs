//! Image metrics as plain functions.

/// Dice overlap of two masks; 1 when both are empty.
pub fn dice(a: &[bool], b: &[bool]) -> f64 {
    let both = a.iter().zip(b).filter(|(x, y)| **x && **y).count();
    let sum = a.iter().filter(|x| **x).count() + b.iter().filter(|x| **x).count();
    if sum == 0 { 1.0 } else { 2.0 * both as f64 / sum as f64 }
}

/// Both images brought to the true image's range (method, section 5).
pub fn normalised(truth: &[f32], prediction: &[f32]) -> (Vec<f64>, Vec<f64>) {
    let (low, high) = truth.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
    let range = if high > low { f64::from(high - low) } else { 1.0 };
    let scale = |v: &f32| (f64::from(*v) - f64::from(low)) / range;
    (truth.iter().map(scale).collect(), prediction.iter().map(scale).collect())
}

/// Peak signal-to-noise ratio in dB for data of range 1.
pub fn psnr(truth: &[f64], prediction: &[f64]) -> f64 {
    let mse = truth.iter().zip(prediction).map(|(a, b)| (a - b).powi(2)).sum::<f64>() / truth.len() as f64;
    -10.0 * mse.max(1e-20).log10()
}

/// Structural similarity (Wang et al. 2004) for data of range 1: 11 x 11 Gaussian window of 1.5 pixels,
/// K1 = 0.01, K2 = 0.03, mean over the pixels whose window lies inside.
pub fn ssim(truth: &[f64], prediction: &[f64], width: usize) -> f64 {
    const RADIUS: usize = 5;
    let height = truth.len() / width;
    if width <= 2 * RADIUS || height <= 2 * RADIUS {
        return f64::NAN;
    }
    let kernel: Vec<f64> =
        (-(RADIUS as i32)..=RADIUS as i32).map(|d| (-0.5 * (f64::from(d) / 1.5).powi(2)).exp()).collect();
    let total: f64 = kernel.iter().sum();
    let kernel: Vec<f64> = kernel.iter().map(|k| k / total).collect();
    let blur = |value: &dyn Fn(usize) -> f64| -> Vec<f64> {
        let (w, h) = (width - 2 * RADIUS, height - 2 * RADIUS);
        let mut rows = vec![0.0; w * height];
        for y in 0..height {
            for x in 0..w {
                rows[y * w + x] = kernel.iter().enumerate().map(|(k, c)| c * value(y * width + x + k)).sum();
            }
        }
        let mut out = vec![0.0; w * h];
        for y in 0..h {
            for x in 0..w {
                out[y * w + x] = kernel.iter().enumerate().map(|(k, c)| c * rows[(y + k) * w + x]).sum();
            }
        }
        out
    };
    let mean_t = blur(&|i| truth[i]);
    let mean_p = blur(&|i| prediction[i]);
    let tt = blur(&|i| truth[i] * truth[i]);
    let pp = blur(&|i| prediction[i] * prediction[i]);
    let tp = blur(&|i| truth[i] * prediction[i]);
    let (c1, c2) = (0.01f64.powi(2), 0.03f64.powi(2));
    let sum: f64 = (0..mean_t.len())
        .map(|i| {
            let (a, b) = (mean_t[i], mean_p[i]);
            let (va, vb, cov) = (tt[i] - a * a, pp[i] - b * b, tp[i] - a * b);
            (2.0 * a * b + c1) * (2.0 * cov + c2) / ((a * a + b * b + c1) * (va + vb + c2))
        })
        .sum();
    sum / mean_t.len() as f64
}

/// Otsu's threshold of a list of values (256 bins).
pub fn otsu(values: &[f32]) -> f32 {
    const BINS: usize = 256;
    let (low, high) = values.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
    if high <= low || values.is_empty() {
        return high;
    }
    let mut counts = [0f64; BINS];
    for v in values {
        counts[(((v - low) / (high - low) * BINS as f32) as usize).min(BINS - 1)] += 1.0;
    }
    let total: f64 = counts.iter().sum();
    let mean_all: f64 = counts.iter().enumerate().map(|(i, c)| i as f64 * c).sum::<f64>() / total;
    let (mut weight, mut sum, mut best, mut best_at) = (0.0, 0.0, -1.0, 0);
    for (i, c) in counts.iter().enumerate() {
        weight += c;
        sum += i as f64 * c;
        if weight == 0.0 || weight == total {
            continue;
        }
        let between = (mean_all * weight - sum).powi(2) / (weight * (total - weight));
        if between > best {
            (best, best_at) = (between, i);
        }
    }
    low + (best_at as f32 + 1.0) / BINS as f32 * (high - low)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dice_of_halves() {
        assert_eq!(dice(&[true, true, false], &[true, false, false]), 2.0 / 3.0);
        assert_eq!(dice(&[false], &[false]), 1.0);
        assert_eq!(dice(&[true], &[false]), 0.0);
    }

    #[test]
    fn psnr_of_a_known_error() {
        assert!((psnr(&[0.0, 1.0], &[0.1, 0.9]) - 20.0).abs() < 1e-9);
    }

    #[test]
    fn ssim_is_one_for_equal_and_less_for_noise() {
        let truth: Vec<f64> = (0..400).map(|i| f64::from(i % 20) / 20.0).collect();
        assert!((ssim(&truth, &truth, 20) - 1.0).abs() < 1e-12);
        let noisy: Vec<f64> =
            truth.iter().enumerate().map(|(i, v)| v + 0.3 * f64::from(u8::from(i % 2 == 0))).collect();
        assert!(ssim(&truth, &noisy, 20) < 0.8);
    }

    #[test]
    fn otsu_splits_two_groups() {
        let mut values = vec![0.1f32; 90];
        values.extend([0.9f32; 10]);
        let t = otsu(&values);
        assert!(t > 0.1 && t < 0.9, "{t}");
    }
}
