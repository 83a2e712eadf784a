//! Options of reading X-ray angiography runs, shared by `import dicom` and `watch`.

use super::options::choice;
use super::synthetic_args::pitch;
use clap::Args;
use nertca_vk::choice::Choice;
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::import::angiograms::{Gating, ImportOptions};
use nertca_vk::scan::gating::{BeatScaling, RPeaks};
use std::path::{Path, PathBuf};

/// Options of reading runs.
#[derive(Debug, Args)]
pub struct DicomArgs {
    /// Number of cardiac phases.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub phases: u32,
    /// The object does not move: average each run. Phase 0 is the object, and phase 1 is the same object without
    /// vessels.
    #[arg(long, conflicts_with_all = ["r_peaks", "heart_rate", "phase_list"])]
    pub still: bool,
    /// R-peaks in seconds from the first frame, one per line, instead of the files' ECG.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["heart_rate", "phase_list"])]
    pub r_peaks: Option<PathBuf>,
    /// Heart rate, beats per minute, of a regular rhythm with an R-peak at the first frame.
    #[arg(long, value_name = "PER_MIN", conflicts_with = "phase_list")]
    pub heart_rate: Option<f64>,
    /// Find the beat of each run from the motion of its vessels, without an ECG. A regular rhythm is assumed; at least
    /// one and a half beats must be filled with contrast.
    #[arg(long, conflicts_with_all = ["still", "r_peaks", "heart_rate", "phase_list"])]
    pub gate_by_images: bool,
    /// Conversion of times between R-peaks to phases.
    #[arg(long, value_parser = choice::<BeatScaling>(), default_value = BeatScaling::default().name())]
    pub beat_scaling: BeatScaling,
    /// Phase (from 0) of each selected frame, one per line, the same for all runs; a frame may lie between two phases, e.g.
    /// 3.4.
    #[arg(long, value_name = "FILE")]
    pub phase_list: Option<PathBuf>,
    /// Frames of each run to use, from 1; by default those filled with contrast.
    #[arg(long, value_name = "FIRST-LAST", value_parser = frame_range)]
    pub frames: Option<std::ops::RangeInclusive<usize>>,
    /// Pixel pitch on the detector along columns and rows, mm: one number or two.
    #[arg(long, value_name = "MM[,MM]", value_parser = pitch)]
    pub pixel_spacing: Option<[f64; 2]>,
    /// Longest side of the images, pixels: larger images are reduced by averaging.
    #[arg(long)]
    pub size: Option<usize>,
    /// Depth range to reconstruct in front of and behind the isocentre, mm.
    #[arg(long, default_value_t = 100.0, value_name = "MM")]
    pub depth: f64,
}

impl DicomArgs {
    /// Converts the options to those of the library.
    ///
    /// # Errors
    /// [`Error::Config`] and [`Error::Data`] for an option or a file that cannot be used.
    pub fn options(&self) -> Result<ImportOptions> {
        if !(self.depth.is_finite() && self.depth > 0.0) {
            return Err(Error::config("depth", self.depth, "is not a positive length in mm"));
        }
        let gating = match (self.still, &self.r_peaks, self.heart_rate, &self.phase_list) {
            _ if self.gate_by_images => Gating::Images,
            (true, ..) => Gating::Still,
            (_, Some(file), ..) => Gating::RPeaks(RPeaks::new(&list::<f64>(file)?)?),
            (_, _, Some(rate), _) => Gating::HeartRate(rate),
            (_, _, _, Some(file)) => Gating::Phases(list(file)?),
            _ => Gating::Ecg,
        };
        Ok(ImportOptions {
            phases: self.phases,
            gating,
            scaling: self.beat_scaling,
            frames: self.frames.clone(),
            pixel_mm: self.pixel_spacing,
            size: self.size,
            depth_half_extent_mm: self.depth,
        })
    }
}

/// Parses `FIRST-LAST`.
fn frame_range(text: &str) -> std::result::Result<std::ops::RangeInclusive<usize>, String> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    match (first.trim().parse(), last.trim().parse()) {
        (Ok(first), Ok(last)) if first <= last => Ok(first..=last),
        _ => Err("is not of the form FIRST-LAST, e.g. 5-12".into()),
    }
}

/// Reads one value per line; text after a `#` is ignored.
fn list<T: std::str::FromStr>(path: &Path) -> Result<Vec<T>> {
    let text =
        String::from_utf8(files::read_limited(path, 1 << 20)?).map_err(|e| Error::data(path, "text", e.to_string()))?;
    let lines = text.lines().map(|l| l.split('#').next().unwrap_or_default().trim()).enumerate();
    lines
        .filter(|(_, line)| !line.is_empty())
        .map(|(i, line)| {
            line.parse().map_err(|_| Error::data(path, format!("line {}", i + 1), format!("`{line}` is not a number")))
        })
        .collect()
}
