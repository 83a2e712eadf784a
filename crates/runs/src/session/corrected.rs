//! How a session's reconstruction sees its frames.

use crate::calibrate::choose::Correction;
use crate::calibrate::correction::{Calibration, ViewCorrection};
use crate::error::{Error, Result};
use crate::geometry::world_from_lps_mm;
use crate::scan::dataset::{Frame, View};
use glam::DVec3;

/// A frame as calibration sees it.
#[derive(Debug, Clone, PartialEq)]
pub struct CorrectedFrame {
    /// How this frame is corrected.
    pub correction: Correction,
    /// Correction of the frame's view; none where the view is taken as stated.
    pub view: Option<ViewCorrection>,
    /// Displacement of the heart by breathing (left, posterior, superior), mm.
    pub heart_shift_mm: [f64; 3],
    /// Projection from patient mm (left, posterior, superior) to homogeneous pixels (column, row; integers are pixel centres),
    /// rows first: it draws the vessels where this frame shows them.
    pub projection: [[f64; 4]; 3],
}

impl CorrectedFrame {
    /// Creates the corrected frame; `phase` is the frame's phase, and `view` is its view.
    pub(super) fn new(
        view: &View,
        frame: &Frame,
        phase: Option<u32>,
        calibration: &Calibration,
    ) -> Result<CorrectedFrame> {
        // The stated geometry may have been changed since.
        let corrected = calibration.views.iter().find(|c| c.view == frame.view && c.stated == view.geometry);
        let rays = match corrected {
            Some(c) => c.corrected.rays(view.size[0], view.size[1]).map_err(|(field, problem)| {
                Error::config("frame", &frame.name, format!("corrected geometry: {field}: {problem}"))
            })?,
            None => view.rays.clone(),
        };
        let shift =
            calibration.frames.iter().find(|c| corrected.is_some() && c.view == frame.view && Some(c.phase) == phase);
        let [posterior, left, superior] = shift.map_or([0.0; 3], |c| c.heart_shift_mm);
        let heart_shift_mm = [left, posterior, superior];
        let way = world_from_lps_mm(DVec3::from_array(heart_shift_mm));
        Ok(CorrectedFrame {
            correction: match (corrected, shift) {
                (None, _) => Correction::Stated,
                (Some(_), None) => Correction::Static,
                (Some(_), Some(_)) => Correction::Breathing,
            },
            view: corrected.cloned(),
            heart_shift_mm,
            projection: rays.moved(way).projection(),
        })
    }
}
