//! Image metrics.

/// Number of steps in the search for the best threshold.
const CANDIDATES: u32 = 200;

/// Dice overlap of two masks; 1 when both are empty.
pub fn dice(a: &[bool], b: &[bool]) -> f64 {
    let both = a.iter().zip(b).filter(|(x, y)| **x && **y).count();
    let sum = a.iter().filter(|x| **x).count() + b.iter().filter(|x| **x).count();
    if sum == 0 { 1.0 } else { 2.0 * both as f64 / sum as f64 }
}

/// Scales both images to the true image's range (method, section 5).
pub fn normalised(truth: &[f32], prediction: &[f32]) -> (Vec<f64>, Vec<f64>) {
    let (low, high) = truth.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
    let range = if high > low { f64::from(high - low) } else { 1.0 };
    let scale = |v: &f32| (f64::from(*v) - f64::from(low)) / range;
    (truth.iter().map(scale).collect(), prediction.iter().map(scale).collect())
}

/// Scales the true image to its own range, and clamps X-Gaussian's image, which is trained to equal it, to 0 to 1.
pub fn normalised_to_shown(truth: &[f32], shown: &[f32]) -> (Vec<f64>, Vec<f64>) {
    let (truth, _) = normalised(truth, &[]);
    (truth, shown.iter().map(|v| f64::from(*v).clamp(0.0, 1.0)).collect())
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

/// Returns the maximum mean Dice of several images over thresholds (values above the threshold against a mask), and its
/// threshold. `used` is tried, too. Returns `None` without images.
pub fn best_dice(images: &[(&[f32], &[bool])], used: f32) -> Option<(f64, f32)> {
    let sorted = |values: &mut dyn Iterator<Item = f32>| {
        let mut values: Vec<f32> = values.collect();
        values.sort_unstable_by(f32::total_cmp);
        values
    };
    let above = |sorted: &[f32], threshold: f32| sorted.len() - sorted.partition_point(|v| *v <= threshold);
    let images: Vec<(Vec<f32>, Vec<f32>)> = images
        .iter()
        .map(|(values, mask)| {
            let in_mask = values.iter().zip(*mask).filter(|(_, inside)| **inside).map(|(v, _)| *v);
            (sorted(&mut values.iter().copied()), sorted(&mut { in_mask }))
        })
        .collect();
    let pooled = sorted(&mut images.iter().flat_map(|(all, _)| all.iter().copied()));
    // The shares of pixels above the threshold range from one half to a few pixels, evenly on a logarithmic scale.
    let candidates = (0..=CANDIDATES).map(|i| {
        let share = 0.5 * (2.0 / pooled.len().max(2) as f64).powf(f64::from(i) / f64::from(CANDIDATES));
        pooled.get(((1.0 - share) * (pooled.len().max(1) - 1) as f64) as usize).copied().unwrap_or(used)
    });
    let mean_dice = |threshold: f32| {
        let each = images.iter().map(|(all, in_mask)| {
            let sum = above(all, threshold) + in_mask.len();
            if sum == 0 { 1.0 } else { 2.0 * above(in_mask, threshold) as f64 / sum as f64 }
        });
        each.sum::<f64>() / images.len() as f64
    };
    let tried = candidates.chain([used]).map(|threshold| (mean_dice(threshold), threshold));
    tried.filter(|(dice, _)| dice.is_finite()).max_by(|a, b| a.0.total_cmp(&b.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_shown_is_compared_with_the_true_image_in_its_own_range() {
        let (truth, shown) = normalised_to_shown(&[0.2, 0.3, 0.4], &[-0.1, 0.5, 1.7]);
        let off = truth.iter().zip(&shown).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(off < 1e-6, "{truth:?} {shown:?}");
    }

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
    fn the_best_threshold_is_found() {
        let values = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8];
        let mask = values.map(|v| v > 0.55);
        let (dice, threshold) = best_dice(&[(&values, &mask)], 0.0).unwrap();
        assert!(dice == 1.0 && (0.5..0.6).contains(&threshold), "{dice} at {threshold}");
        // An image with another best threshold is outvoted by two: the mean of 1, 1 and 1/2 decides.
        let few = values.map(|v| v > 0.75);
        let (dice, threshold) = best_dice(&[(&values, &mask), (&values, &mask), (&values, &few)], 0.0).unwrap();
        assert!((dice - 2.5 / 3.0).abs() < 1e-12 && (0.5..0.6).contains(&threshold), "{dice} at {threshold}");
        assert_eq!(best_dice(&[], 0.0), None);
    }
}
