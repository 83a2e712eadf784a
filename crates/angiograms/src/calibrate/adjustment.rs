//! Adjustment of the calibrated geometry with the field of a fit in the loop: its record, and its outcome.

use crate::calibrate::pose::Poses;
use serde::{Deserialize, Serialize};

/// Record of an adjustment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Adjustment {
    /// Whether the adjusted geometry is used.
    pub accepted: bool,
    /// Loss that a fit to the calibrated views leaves, as a share of the loss of the field's own images.
    pub misfit_before: f64,
    /// Loss that a fit to the adjusted views leaves, as a share of the loss of the field's own images; `None` where the views were
    /// not adjusted.
    pub misfit_after: Option<f64>,
}

impl Adjustment {
    /// Describes the outcome and the reason for it.
    pub fn describe(&self) -> String {
        let Adjustment { accepted, misfit_before: before, misfit_after } = self;
        match misfit_after {
            None => {
                format!("the views are not adjusted with the vessels in the loop: a fit leaves a misfit of {before:.2}")
            }
            Some(after) if *accepted => format!(
                "angles, positions, breathing and contrasts were adjusted with the vessels in the loop: the misfit of a fit falls \
                 from {before:.2} to {after:.2}"
            ),
            Some(after) => format!(
                "an adjustment of the views with the vessels in the loop is rejected: it changes the misfit of a fit from \
                 {before:.2} to {after:.2}, which is no clear gain"
            ),
        }
    }
}

/// Outcome of an adjustment.
#[derive(Debug, Clone, PartialEq)]
pub struct Adjusted {
    /// Indices into the dataset's views: those whose training frames show at least two phases.
    pub views: Vec<usize>,
    /// Poses of these views, as corrections of the stated geometry.
    pub poses: Poses,
    /// Record of the adjustment.
    pub record: Adjustment,
}
