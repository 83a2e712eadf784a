//! Initial parameters of a fit: random numbers distributed as in PyTorch.

use crate::methods::sax_nerf::field::{SaxShape, WIDTH};
use crate::random::{STREAM_INIT, normal, uniform01};
use rayon::prelude::*;

/// Maximum absolute initial value of the grid's entries.
const GRID: f64 = 1e-4;
/// Number of standard deviations at which the normal distribution of the attention's biases is truncated.
const CUT: f64 = 2.0;
/// Index of the first draw of these biases, after all other random numbers; one draw in twenty is beyond the cut.
const FIRST_ATTEMPT: u32 = 1000;
const MAX_ATTEMPTS: usize = 100;

/// Returns the initial parameters of a field for the random `seed`.
pub fn first_params(shape: SaxShape, seed: u32) -> Vec<f32> {
    let mut params = vec![0f32; shape.n_params()];
    let fan_in_of_bias =
        |name: &str| if name == "joint.bias" { shape.n_features() + WIDTH } else { shape.n_features() };
    for (index, part) in shape.parts().into_iter().enumerate() {
        let value = |i: usize| -> f64 {
            let spread = || 2.0 * uniform01(seed, STREAM_INIT, i as u32, index as u32) - 1.0;
            let within = |fan_in: usize| spread() / (fan_in as f64).sqrt();
            match part.name {
                "norm1.weight" | "norm2.weight" => 1.0,
                "norm1.bias" | "norm2.bias" => 0.0,
                "grid" => GRID * spread(),
                "attention.position" => cut_normal(seed, i as u32),
                "attention.out.bias" | "density.bias" => within(WIDTH),
                "input.bias" | "joint.bias" => within(fan_in_of_bias(part.name)),
                _ => within(part.shape[part.shape.len() - 1]),
            }
        };
        let numbers = &mut params[part.first..][..part.len()];
        numbers.par_iter_mut().enumerate().for_each(|(i, number)| *number = value(i) as f32);
    }
    params
}

/// Returns a normal number that is not beyond [`CUT`]: the first such number drawn for `index`.
fn cut_normal(seed: u32, index: u32) -> f64 {
    let draws = (0..).map(|attempt| normal(seed, STREAM_INIT, index, FIRST_ATTEMPT + attempt));
    draws.take(MAX_ATTEMPTS).find(|x| x.abs() <= CUT).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_begin_within_their_bounds() {
        let shape = SaxShape { levels: 4, base: 4, log2_table: 8 };
        let params = first_params(shape, 3);
        assert_ne!(params, first_params(shape, 4));
        for part in shape.parts() {
            let numbers = &params[part.first..][..part.len()];
            let largest = numbers.iter().fold(0f32, |m, v| m.max(v.abs()));
            let (min, max) = match part.name {
                "norm1.weight" | "norm2.weight" => (1.0, 1.0),
                "norm1.bias" | "norm2.bias" => (0.0, 0.0),
                "grid" => (0.99e-4, 1e-4),
                "attention.position" => (1.0, 2.0),
                "feed_forward.mix" | "feed_forward.contract" => (0.085, 128f32.powf(-0.5)),
                "input.weight" | "input.bias" => (0.3, 8f32.powf(-0.5)),
                "joint.weight" | "joint.bias" => (0.13, 40f32.powf(-0.5)),
                "density.bias" => (0.0, 32f32.powf(-0.5)),
                _ => (0.15, 32f32.powf(-0.5)),
            };
            assert!((min..=max).contains(&largest), "{}: {largest}", part.name);
        }
    }

    #[test]
    fn the_cut_normal_is_cut_and_normal() {
        let n = 4000;
        let mut draws: Vec<f64> = (0..n).map(|i| cut_normal(1, i)).collect();
        draws.sort_by(f64::total_cmp);
        assert!(draws[0] >= -CUT && draws[n as usize - 1] <= CUT && draws[0] < -1.98);
        // A normal distribution truncated there has a standard deviation of 0.88.
        let variance = draws.iter().map(|x| x * x).sum::<f64>() / f64::from(n);
        assert!((variance.sqrt() - 0.88).abs() < 0.03, "{variance}");
    }
}
