//! `truth.json` of a synthetic dataset: the true acquisition of each image (see `docs/formats.md`).

use crate::error::{Error, Result};
use crate::files;
use crate::geometry::CArm;
use crate::scan::dataset::Split;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Name of the file inside a dataset.
pub const TRUTH: &str = "truth.json";
/// Directory of the volumes inside a dataset.
pub const VOLUMES: &str = "volumes";
const FORMAT: &str = "nertca-truth";
const VERSION: u32 = 1;
const MAX_BYTES: u64 = 256 << 20;

/// True acquisition of the images of a synthetic dataset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Truth {
    /// Always `nertca-truth`.
    format: String,
    /// Version of this layout: 1.
    version: u32,
    /// Seed of all random numbers.
    pub seed: u32,
    /// Number of cardiac phases T.
    pub phases: u32,
    /// Stenoses of the vessels; empty in most datasets.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub lesions: Vec<TrueLesion>,
    /// One entry per image, in the order of the dataset.
    pub frames: Vec<TrueFrame>,
}

/// A true stenosis, at rest (phase 0).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrueLesion {
    /// Name of the branch.
    pub branch: String,
    /// Position of the least diameter, mm along the branch from its first point.
    pub position_mm: f64,
    /// Position of the least diameter, mm along the vessels from the ostium.
    pub from_ostium_mm: f64,
    /// Length along the branch, mm.
    pub length_mm: f64,
    /// Diameter of the vessel there without the stenosis, mm.
    pub reference_diameter_mm: f64,
    /// Least diameter, mm.
    pub min_diameter_mm: f64,
    /// Diameter stenosis, percent.
    pub percent: f64,
}

/// True acquisition of one image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrueFrame {
    /// Image file, as the dataset names it.
    pub image: PathBuf,
    /// View, from 0; training views come first.
    pub view: usize,
    /// Training or validation.
    pub split: Split,
    /// Phase that the dataset states, from 0.
    pub phase: u32,
    /// C-arm that the image was made with; the dataset may state another.
    pub geometry: CArm,
    /// Displacement of the heart from its mean position by breathing, mm along (posterior, left, superior): a point of the
    /// heart at x is seen at x plus this displacement.
    pub heart_shift_mm: [f64; 3],
    /// True phase of the heart, 0 to T, without the errors of the stated phase.
    pub beat_phase: f64,
    /// Time since the first image of the run, seconds.
    pub time_s: f64,
    /// Factor on the contrast of the vessels.
    pub contrast_gain: f64,
    /// Share of the way to the farthest end of the vessels that contrast has reached; 1 where all vessels are filled.
    #[serde(default = "everywhere")]
    pub filled_to: f64,
    /// Share of the view's moving vessels that a blade hides, over all phases.
    pub cut_share: f64,
}

/// Value of [`TrueFrame::filled_to`] in files that do not have the field.
fn everywhere() -> f64 {
    1.0
}

impl Truth {
    /// Makes the truth of a dataset with `phases` phases and no frames.
    pub fn new(seed: u32, phases: u32) -> Truth {
        Truth { format: FORMAT.to_owned(), version: VERSION, seed, phases, lesions: Vec::new(), frames: Vec::new() }
    }

    /// Reads the truth of the dataset in a directory.
    ///
    /// # Errors
    /// [`Error::Io`] where there is none, [`Error::Data`] for a file of another kind.
    pub fn load(dataset: &Path) -> Result<Truth> {
        let file = dataset.join(TRUTH);
        let truth: Truth = files::read_json(&file, MAX_BYTES)?;
        if truth.format != FORMAT || truth.version != VERSION {
            let found = format!(
                "is `{}` version {}, but `{FORMAT}` version {VERSION} is expected",
                truth.format, truth.version
            );
            return Err(Error::data(&file, "format", found));
        }
        Ok(truth)
    }

    /// Writes the truth of the dataset in a directory.
    ///
    /// # Errors
    /// [`Error::Io`] where it cannot be written.
    pub fn write(&self, dataset: &Path) -> Result<()> {
        Ok(files::write_atomic(&dataset.join(TRUTH), files::pretty_json(self)?.as_bytes())?)
    }
}

/// Path of the true vessels at a phase.
pub fn truth_file(volumes: &Path, phase: u32) -> PathBuf {
    volumes.join(format!("vessels-{phase:02}.nrrd"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_files_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        assert!(matches!(Truth::load(directory.path()), Err(Error::Io { .. })));
        let mut truth = Truth::new(7, 10);
        truth.write(directory.path()).unwrap();
        assert_eq!(Truth::load(directory.path()).unwrap(), truth);
        truth.version = 2;
        truth.write(directory.path()).unwrap();
        assert!(Truth::load(directory.path()).unwrap_err().to_string().contains("version 2"));
    }
}
