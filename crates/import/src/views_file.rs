//! Geometry, times and phases of views of pictures, from a TOML file that the user writes.

use crate::angiograms::Gating;
use crate::error::{Error, Result};
use crate::files;
use crate::geometry::{CArm, Geometry};
use crate::pictures::PictureView;
use crate::scan::gating::RPeaks;
use serde::Deserialize;
use std::path::{Path, PathBuf};

/// Largest accepted size of a file, bytes.
const MAX_BYTES: u64 = 1 << 20;

/// Content of a file.
#[derive(Debug, Clone)]
pub struct ViewsFile {
    /// Views, with paths relative to the folder of the file.
    pub views: Vec<PictureView>,
    /// Sources of the phases; one for each view, none where the file states none.
    pub gatings: Vec<Option<Gating>>,
    /// Whether the object does not move.
    pub still: bool,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Content {
    #[serde(default)]
    still: bool,
    /// Values of all views that do not state their own.
    #[serde(default)]
    all: Values,
    view: Vec<View>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct View {
    path: PathBuf,
    angles_deg: [f64; 2],
    #[serde(default)]
    phases: Option<Vec<f64>>,
    #[serde(default)]
    r_peaks_s: Option<Vec<f64>>,
    // Serde does not combine `flatten` with the refusal of unknown keys.
    sid_mm: Option<f64>,
    sod_mm: Option<f64>,
    pixel_mm: Option<Pitch>,
    offset_mm: Option<[f64; 2]>,
    fps: Option<f64>,
    heart_rate_per_min: Option<f64>,
}

#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
struct Values {
    sid_mm: Option<f64>,
    sod_mm: Option<f64>,
    pixel_mm: Option<Pitch>,
    offset_mm: Option<[f64; 2]>,
    fps: Option<f64>,
    heart_rate_per_min: Option<f64>,
}

/// Pitch of pixels along columns and rows, mm.
#[derive(Debug, Clone, Copy, Deserialize)]
#[serde(untagged, expecting = "a number or a list of two numbers is needed")]
enum Pitch {
    Same(f64),
    Each([f64; 2]),
}

impl Pitch {
    fn mm(self) -> [f64; 2] {
        match self {
            Pitch::Same(pitch) => [pitch; 2],
            Pitch::Each(pitches) => pitches,
        }
    }
}

/// Reads a file.
///
/// # Errors
/// [`Error::Data`] naming the file, and the key or the line; [`Error::Io`].
pub fn read(path: &Path) -> Result<ViewsFile> {
    let text = files::read_text(path, MAX_BYTES)?;
    let content: Content = toml::from_str(&text).map_err(|e| {
        let line = e.span().map_or(1, |span| 1 + text[..span.start].matches('\n').count());
        Error::data(path, format!("line {line}"), e.message().to_owned())
    })?;
    if content.view.is_empty() {
        return Err(Error::data(path, "view", "there is none: a table [[view]] is needed for each view"));
    }
    let folder = path.parent().unwrap_or(Path::new(""));
    let (mut views, mut gatings) = (Vec::new(), Vec::new());
    for (i, view) in content.view.iter().enumerate() {
        let bad = |key: &str, problem: String| Error::data(path, format!("view {}: {key}", i + 1), problem);
        views.push(view.picture_view(&content.all, folder).map_err(|(key, problem)| bad(&key, problem))?);
        gatings.push(view.gating(&content.all, content.still).map_err(|(key, problem)| bad(&key, problem))?);
    }
    Ok(ViewsFile { views, gatings, still: content.still })
}

/// Result with a key, and the problem of its value.
type OfKey<T> = std::result::Result<T, (String, String)>;

/// Returns a value that must be stated.
fn stated<T>(key: &str, value: Option<T>) -> OfKey<T> {
    value.ok_or_else(|| (key.into(), "is missing: state it for the view, or for all views in the table [all]".into()))
}

fn positive(key: &str, value: Option<f64>) -> OfKey<Option<f64>> {
    match value {
        Some(value) if !(value.is_finite() && value > 0.0) => {
            Err((key.into(), format!("{value} is not a positive number")))
        }
        value => Ok(value),
    }
}

impl View {
    fn picture_view(&self, all: &Values, folder: &Path) -> OfKey<PictureView> {
        let c_arm = CArm {
            primary_deg: self.angles_deg[0],
            secondary_deg: self.angles_deg[1],
            sid_mm: stated("sid_mm", self.sid_mm.or(all.sid_mm))?,
            sod_mm: stated("sod_mm", self.sod_mm.or(all.sod_mm))?,
            pixel_mm: stated("pixel_mm", self.pixel_mm.or(all.pixel_mm))?.mm(),
            offset_mm: self.offset_mm.or(all.offset_mm).unwrap_or_default(),
            table_mm: [0.0; 3],
        };
        // The size of the pictures is not known yet, and no matter.
        Geometry::CArm(c_arm.clone()).rays(1, 1)?;
        let frames_per_s = positive("fps", self.fps.or(all.fps))?;
        Ok(PictureView { path: folder.join(&self.path), c_arm, frames_per_s })
    }

    fn gating(&self, all: &Values, still: bool) -> OfKey<Option<Gating>> {
        let rate = positive("heart_rate_per_min", self.heart_rate_per_min.or(all.heart_rate_per_min))?;
        let given = [
            ("phases", self.phases.is_some()),
            ("r_peaks_s", self.r_peaks_s.is_some()),
            ("heart_rate_per_min", self.heart_rate_per_min.is_some()),
        ];
        let mut given = given.iter().filter(|(_, given)| *given).map(|(key, _)| *key);
        match (given.next(), given.next()) {
            (Some(key), _) if still => {
                return Err((key.into(), "has no meaning for an object at rest (still = true)".into()));
            }
            (Some(first), Some(second)) => {
                return Err((second.into(), format!("is given together with {first}: one of them is needed")));
            }
            _ => (),
        }
        if let Some(phases) = &self.phases {
            return Ok(Some(Gating::Phases(phases.clone())));
        }
        if let Some(peaks) = &self.r_peaks_s {
            let peaks = RPeaks::new(peaks).map_err(|e| ("r_peaks_s".to_owned(), e.to_string()))?;
            return Ok(Some(Gating::RPeaks(peaks)));
        }
        Ok(rate.filter(|_| !still).map(Gating::HeartRate))
    }
}
