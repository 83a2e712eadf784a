//! Adjustment of a session's views.

use crate::calibrate::adjusted;
use crate::calibrate::correction::Calibration;
use crate::error::Result;
use crate::fitting::fit::{AdjustTask, AdjustedFit, MadeFit};
use crate::methods;

/// Outcome of the adjustment of a session's views.
pub(super) struct AdjustedViews {
    pub(super) calibration: Calibration,
    /// Whether the calibration of views has changed.
    pub(super) are_corrected: bool,
    /// Fit to these views; none where it was made with coarser images, or no adjustment was tried.
    pub(super) made: Option<MadeFit>,
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
    let adjust = methods::of(task.config).abilities.adjust_views;
    let outcome = adjust.map_or(Ok(None), |adjust| adjust(task, &mut observe))?;
    let Some(AdjustedFit { adjusted: outcome, made }) = outcome else {
        return Ok(AdjustedViews { calibration, are_corrected: false, made: None });
    };
    tracing::info!("{}", outcome.record.describe());
    let are_corrected = outcome.record.accepted;
    Ok(AdjustedViews { calibration: adjusted(task.dataset, calibration, outcome)?, are_corrected, made })
}
