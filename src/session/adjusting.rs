//! Adjustment of a session's views.

use crate::calibrate::adjusted;
use crate::calibrate::correction::Calibration;
use crate::error::Result;
use crate::fitting::fit::{AdjustTask, AdjustedFit, MadeGaussians};
use crate::methods;
use crate::scan::dataset::Dataset;

/// Outcome of the adjustment of a session's views.
pub(super) struct AdjustedViews {
    pub(super) calibration: Calibration,
    /// Views that were corrected; none where they stay as they are.
    pub(super) corrected: Option<CorrectedViews>,
}

/// Views that were corrected.
pub(super) struct CorrectedViews {
    pub(super) dataset: Dataset,
    /// Fit to these views; none where it was made with coarser images.
    pub(super) made: Option<MadeGaussians>,
}

/// Adjusts views, and logs the progress. `proceed` is called before every few iterations and may end the adjustment by an error.
///
/// # Errors
/// Errors of `proceed`; device errors.
pub(super) fn adjust(task: &AdjustTask<'_>, proceed: &dyn Fn() -> Result<()>) -> Result<AdjustedViews> {
    let mut told = 0;
    let mut observe = |share: f64| {
        proceed()?;
        let tenths = (10.0 * share) as u32;
        if tenths > told {
            told = tenths;
            tracing::info!("adjusting views, {:.0} %", 100.0 * share);
        }
        Ok(())
    };
    let calibration = task.calibration.clone();
    let Some(AdjustedFit { adjusted: outcome, made }) = methods::of(task.config).adjust(task, &mut observe)? else {
        return Ok(AdjustedViews { calibration, corrected: None });
    };
    tracing::info!("{}", outcome.record.describe());
    let accepted = outcome.record.accepted;
    let calibration = adjusted(task.dataset, calibration, outcome)?;
    let corrected = match accepted {
        true => Some(CorrectedViews { dataset: task.dataset.corrected(&calibration)?, made }),
        false => None,
    };
    Ok(AdjustedViews { calibration, corrected })
}
