//! Thresholds above which a field counts as vessel.

use crate::error::Result;
use crate::geometry::MM_PER_UNIT;
use crate::model::Model;
use crate::model::component::Component;
use crate::raster::percentile;
use crate::render::grid::PatientGrid;
use crate::render::renderer::Renderer;

/// Share of the vessels' stated attenuation from which a field counts as vessel. Fields are smoother than vessels, so one
/// half would cut thin ones off, and one tenth would include noise. Among the shares tried (docs/tried.md), one fifth
/// is within 0.04 of the best Dice in all cases: both forms of dynamic field, phantoms and real anatomy, with and without
/// noise.
pub const VESSEL_SHARE: f64 = 0.2;
/// Attenuation per world unit above which the authors' public code takes a field for vessel, whatever the data.
pub const PUBLISHED_THRESHOLD: f64 = 0.05;
/// Values above this percentile are limited to it in the search for a threshold. The 99th percentile is 0 where vessels cover less than 1
/// % (docs/tried.md).
const HOT: f64 = 0.995;

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

/// Otsu's threshold for vessels in values that are mostly zero and have a few hot spots. Values are limited to their 99.5th
/// percentile: otherwise one pixel in two thousand far above all vessels would form the upper group. The threshold is zero
/// where fewer values than that exceed zero.
pub fn vessel_threshold(values: &[f32]) -> f32 {
    let hottest = percentile(values, HOT);
    otsu(&values.iter().map(|v| v.min(hottest)).collect::<Vec<_>>())
}

/// Threshold for vessels whose attenuation is not stated, from values of a field that are mostly zero: [`VESSEL_SHARE`] of the strongest one,
/// hot spots left out, which stands for the attenuation of the vessels. Zero where fewer than half a percent of the values exceed zero.
pub fn threshold_of_unstated(values: &[f32]) -> f32 {
    VESSEL_SHARE as f32 * percentile(values, HOT)
}

/// Attenuation per mm above which the dynamic field of a model counts as vessel: [`VESSEL_SHARE`] of the stated one, or
/// [`threshold_of_unstated`] of the field's values at phase 0 on a grid; for X-Gaussian's opacities the published threshold.
///
/// # Errors
/// Errors of [`Renderer::sample_patient`].
pub fn vessel_threshold_per_mm(renderer: &Renderer, model: &Model, grid: &PatientGrid) -> Result<f64> {
    if renderer.is_blended() {
        return Ok(PUBLISHED_THRESHOLD / MM_PER_UNIT);
    }
    if let Some(attenuation) = model.vessel_attenuation {
        return Ok(VESSEL_SHARE * attenuation / MM_PER_UNIT);
    }
    let values = renderer.sample_patient(Component::Dynamic, 0, grid)?;
    let inside: Vec<f32> = values.into_iter().filter(|v| *v > 0.0).collect();
    Ok(f64::from(threshold_of_unstated(&inside)))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Values spread evenly about two levels.
    fn two_levels(low: f32, n_low: usize, high: f32, n_high: usize) -> Vec<f32> {
        let spread = |level: f32, n: usize| (0..n).map(move |i| level * (0.6 + 0.8 * i as f32 / n as f32));
        spread(low, n_low).chain(spread(high, n_high)).collect()
    }

    #[test]
    fn otsu_splits_two_groups_where_they_part() {
        // The lower group ends at 0.14, the upper one begins at 0.6; a histogram's bin is 0.005 wide.
        let t = otsu(&two_levels(0.1, 900, 1.0, 100));
        assert!((0.14..0.146).contains(&t), "{t}");
        // Where groups meet, the threshold is one bin after the lower group's end, and many values of the upper one are
        // below it.
        let t = otsu(&two_levels(0.1, 500, 0.4, 500));
        assert!((0.255..0.265).contains(&t), "{t}");
    }

    #[test]
    fn a_few_hot_spots_do_not_move_the_threshold() {
        let mut values = two_levels(0.1, 900, 1.0, 100);
        values.extend([0.0; 5000]);
        let cool = vessel_threshold(&values);
        values.extend([40.0, 55.0, 60.0, 70.0]);
        let hot = vessel_threshold(&values);
        assert!((cool - hot).abs() < 0.02 && (0.13..0.6).contains(&hot), "{cool} without, {hot} with hot spots");
        assert!(otsu(&values) > 1.4, "Otsu alone sees the hot spots only: {}", otsu(&values));
    }

    #[test]
    fn vessels_of_unknown_attenuation_are_found_to_a_fifth_of_the_strongest() {
        // Two percent of thick vessels, as much of thin ones, and hot spots.
        let mut values = two_levels(0.3, 200, 1.0, 200);
        values.extend([0.0; 9600]);
        values.extend([40.0; 4]);
        let threshold = threshold_of_unstated(&values);
        assert!((0.15..0.25).contains(&threshold), "{threshold}");
        assert!(vessel_threshold(&values) > 0.4, "Otsu's threshold cuts the thin ones off");
        assert_eq!(threshold_of_unstated(&[0.0; 10]), 0.0);
    }
}
