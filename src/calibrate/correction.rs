//! What was corrected, why, and what came of it: `calibration.json`.

use crate::calibrate::choose::Correction;
use crate::error::{Error, Result};
use crate::files;
use crate::geometry::Geometry;
use crate::scan::dataset::Dataset;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Name of the file in a run, or in a dataset that was corrected.
pub const FILE: &str = "calibration.json";
const MAX_BYTES: u64 = 64 << 20;

/// Correction of one view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ViewCorrection {
    /// Index into the dataset's views.
    pub view: usize,
    /// Added to the primary angle, degrees.
    pub primary_deg: f64,
    /// Added to the secondary angle, degrees.
    pub secondary_deg: f64,
    /// How much further than stated the table has carried the patient along (left, posterior, superior), mm.
    pub table_mm: [f64; 3],
    /// Root mean square of how far the correction moves the heart's image, pixels, less what moves all views alike.
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

/// Correction of one frame: where breathing has carried the heart.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameCorrection {
    /// Index into the dataset's views.
    pub view: usize,
    /// Cardiac phase.
    pub phase: u32,
    /// Displacement along (posterior, left, superior), mm.
    pub heart_shift_mm: [f64; 3],
}

/// The outcome.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// What was corrected.
    pub correction: Correction,
    /// Per view; empty where nothing was.
    pub views: Vec<ViewCorrection>,
    /// Per frame; empty unless breathing was corrected.
    pub frames: Vec<FrameCorrection>,
    /// How far views disagreed: root mean square of how far the correction moves the heart's images, pixels.
    pub disagreement_px: f64,
    /// How well the correction is known: half of what the corrections by even and by odd phases differ by, pixels. Errors
    /// that both have alike do not show.
    pub repeatability_px: Option<f64>,
    /// Residual at phases that were not fitted, as a share of the profiles: as stated, static, breathing, as far as tried.
    pub tried: Vec<(Correction, f64)>,
    /// Share of the pixels that show vessels for which all other views show some on the ray, to a pixel: before and after.
    pub explained: [f64; 2],
    /// What was done and why, in words.
    pub notes: Vec<String>,
}

impl Calibration {
    /// Nothing is corrected, for a reason.
    pub fn none(note: Option<String>) -> Calibration {
        Calibration {
            correction: Correction::Stated,
            views: Vec::new(),
            frames: Vec::new(),
            disagreement_px: 0.0,
            repeatability_px: None,
            tried: Vec::new(),
            explained: [0.0; 2],
            notes: note.into_iter().collect(),
        }
    }

    /// Writes it into a directory.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, directory: &Path) -> Result<()> {
        files::write_atomic(&directory.join(FILE), files::pretty_json(self)?.as_bytes())
    }

    /// Reads that of a run; none where the run has none, as those of before.
    ///
    /// # Errors
    /// [`Error::Io`] or [`Error::Data`].
    pub fn read(run: &Path) -> Result<Option<Calibration>> {
        let directory = if run.is_file() { run.parent().unwrap_or(Path::new(".")) } else { run };
        let file = directory.join(FILE);
        if !file.is_file() {
            return Ok(None);
        }
        let text = files::read_limited(&file, MAX_BYTES)?;
        let parsed = serde_json::from_slice(&text);
        parsed.map(Some).map_err(|e| Error::data(&file, format!("line {}", e.line()), e.to_string()))
    }

    /// What the geometry of a view was stated to be, where it was corrected.
    pub fn stated(&self, view: usize) -> Option<&Geometry> {
        self.views.iter().find(|c| c.view == view).map(|c| &c.stated)
    }
}

impl Dataset {
    /// The dataset with corrected geometry.
    ///
    /// # Errors
    /// [`Error::Config`] when the correction is of other views.
    pub fn corrected(&self, calibration: &Calibration) -> Result<Dataset> {
        let other =
            |what: String| Error::config(FILE, what, "is not what the dataset states: it was made for other data");
        let mut corrected = self.clone();
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
            frames.for_each(|f| f.heart_shift_mm = [0, 1, 2].map(|k| f.heart_shift_mm[k] + c.heart_shift_mm[k]));
        }
        Ok(corrected)
    }
}
