//! The correction of the views, the reasons for it and its outcome: `calibration.json`.

use crate::calibrate::adjustment::Adjustment;
use crate::calibrate::choose::Correction;
use crate::error::{Error, Result};
use crate::files;
use crate::geometry::Geometry;
use crate::scan::dataset::Dataset;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Name of the file in a run, or in a corrected dataset.
pub const FILE: &str = "calibration.json";
const MAX_BYTES: u64 = 64 << 20;

/// Correction of one view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewCorrection {
    /// Index into the dataset's views.
    pub view: usize,
    /// Correction added to the primary angle, degrees.
    pub primary_deg: f64,
    /// Correction added to the secondary angle, degrees.
    pub secondary_deg: f64,
    /// Table displacement of the patient beyond the stated one, along (left, posterior, superior), mm.
    pub table_mm: [f64; 3],
    /// Root mean square displacement of the heart's image by the correction, without the motion common to all views,
    /// pixels.
    pub moved_px: f64,
    /// Difference of this view's profiles from those of the others before the correction, as a share of the profiles.
    pub residual_before: f64,
    /// Difference of this view's profiles from those of the others after the correction, as a share of the profiles.
    pub residual_after: f64,
    /// Geometry of the view as stated.
    pub stated: Geometry,
    /// Geometry of the view as corrected.
    pub corrected: Geometry,
}

/// Correction of one frame: the displacement of the heart by breathing.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameCorrection {
    /// Index into the dataset's views.
    pub view: usize,
    /// Cardiac phase.
    pub phase: u32,
    /// Displacement along (posterior, left, superior), mm.
    pub heart_shift_mm: [f64; 3],
    /// Contrast of the vessels in this frame, as a multiple of the mean over the frames.
    #[serde(default = "mean_contrast", skip_serializing_if = "is_mean_contrast")]
    pub contrast: f64,
}

fn mean_contrast() -> f64 {
    1.0
}

fn is_mean_contrast(contrast: &f64) -> bool {
    *contrast == 1.0
}

/// Outcome of the self-calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Kind of correction.
    pub correction: Correction,
    /// Corrections of the views; empty where none was made.
    pub views: Vec<ViewCorrection>,
    /// Corrections of the frames; empty unless breathing was corrected.
    pub frames: Vec<FrameCorrection>,
    /// Disagreement of the views: root mean square displacement of the heart's images by the correction, pixels.
    pub disagreement_px: f64,
    /// Precision of the correction: half the distance between the corrections by the even and by the odd phases, pixels. It
    /// does not show errors that both have in common.
    pub repeatability_px: Option<f64>,
    /// Residual at phases that were not fitted, as a share of the profiles, for each correction that was tried: stated,
    /// static, breathing.
    pub tried: Vec<(Correction, f64)>,
    /// Share of the vessel pixels for which all other views show a vessel on the ray, to within a pixel: before and after
    /// the correction.
    pub explained: [f64; 2],
    /// Share that would be explained by chance, with the vessels of a view displaced; `None` where it was not determined.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub explained_by_chance: Option<f64>,
    /// Adjustment with the field in the loop; `None` where it was not tried.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub adjustment: Option<Adjustment>,
    /// Notes on what was done and why.
    pub notes: Vec<String>,
}

impl Calibration {
    /// Returns the outcome without a correction, with the reason.
    pub fn none(note: Option<String>) -> Calibration {
        Calibration {
            correction: Correction::Stated,
            views: Vec::new(),
            frames: Vec::new(),
            disagreement_px: 0.0,
            repeatability_px: None,
            tried: Vec::new(),
            explained: [0.0; 2],
            explained_by_chance: None,
            adjustment: None,
            notes: note.into_iter().collect(),
        }
    }

    /// Writes the outcome into a directory.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, directory: &Path) -> Result<()> {
        Ok(files::write_atomic(&directory.join(FILE), files::pretty_json(self)?.as_bytes())?)
    }

    /// Reads the calibration of a run; `None` where the run has none.
    ///
    /// # Errors
    /// [`Error::Io`] or [`Error::Data`].
    pub fn read(run: &Path) -> Result<Option<Calibration>> {
        let directory = if run.is_file() { run.parent().unwrap_or(Path::new(".")) } else { run };
        let file = directory.join(FILE);
        if !file.is_file() {
            return Ok(None);
        }
        Ok(files::read_json(&file, MAX_BYTES).map(Some)?)
    }

    /// Stated geometry of a view that was corrected.
    pub fn stated(&self, view: usize) -> Option<&Geometry> {
        self.views.iter().find(|c| c.view == view).map(|c| &c.stated)
    }
}

impl Dataset {
    /// The dataset with corrected geometry.
    ///
    /// # Errors
    /// [`Error::Config`] when the correction belongs to other views.
    pub fn corrected(&self, calibration: &Calibration) -> Result<Dataset> {
        let other = |what: String| {
            Error::config(FILE, what, "does not agree with the dataset: the correction was made for other data")
        };
        let mut corrected = self.clone();
        corrected.views_adjusted |= calibration.adjustment.as_ref().is_some_and(|adjustment| adjustment.accepted);
        for c in &calibration.views {
            let view = corrected.views.get_mut(c.view).filter(|view| view.geometry == c.stated);
            let view = view.ok_or_else(|| other(format!("view {}", c.view)))?;
            view.rays = c
                .corrected
                .rays(view.size[0], view.size[1])
                .map_err(|(field, problem)| Error::config(FILE, format!("view {}: {field}", c.view), problem))?;
            view.geometry = c.corrected.clone();
        }
        for c in &calibration.frames {
            let frames = corrected.frames.iter_mut().filter(|f| (f.view, f.phase) == (c.view, c.phase));
            frames.for_each(|f| {
                f.heart_shift_mm = [0, 1, 2].map(|k| f.heart_shift_mm[k] + c.heart_shift_mm[k]);
                f.contrast *= c.contrast;
            });
        }
        Ok(corrected)
    }
}
