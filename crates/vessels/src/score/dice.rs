//! Dice of an image and of the best threshold, which scores of fields and of the true vessels share.

use crate::scan::dataset::Frame;
use crate::score::metrics;
use serde::Serialize;

/// Maximum of the mean Dice over all thresholds, which distinguishes a bad field from a bad threshold. It is found with the
/// masks of the scored images themselves, so it is no valid score.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BestDice {
    /// Mean over images with a mask.
    pub dice: f64,
    /// The threshold at this maximum, per mm.
    pub threshold_per_mm: f64,
}

/// Dice between the values above a threshold and the mask of a frame; `None` without a mask.
pub(super) fn overlap(frame: &Frame, values: &[f32], threshold: f64) -> Option<f64> {
    let mask = frame.mask.as_ref()?;
    let predicted: Vec<bool> = values.iter().map(|v| f64::from(*v) > threshold).collect();
    Some(metrics::dice(&predicted, mask))
}

/// Mean of values; `None` if there are none.
pub(super) fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (n, sum) = values.fold((0usize, 0.0), |(n, sum), value| (n + 1, sum + value));
    (n > 0).then(|| sum / n as f64)
}
