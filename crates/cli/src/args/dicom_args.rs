//! Options of reading X-ray angiography runs, shared by `import dicom`, `import pictures` and `watch`.

use crate::args::options::choice;
use crate::args::synthetic_args::{AngleList, pitch, view_angles};
use clap::{ArgAction, Args};
use nertca_vk::choice::Choice;
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::scan::gating::{BeatScaling, RPeaks};
use nertca_vk_import::angiograms::{Gating, ImportOptions};
use nertca_vk_import::intake::StatedRun;
use nertca_vk_import::stated::StatedGeometry;
use std::path::{Path, PathBuf};

/// Largest accepted size of a list of times or phases, bytes.
const MAX_LIST_BYTES: u64 = 1 << 20;

/// Options of runs of any source.
#[derive(Debug, Args)]
pub struct RunArgs {
    /// Number of cardiac phases.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub phases: u32,
    /// The object does not move: average each run. The dataset says so, and results have one phase.
    #[arg(long, conflicts_with_all = ["r_peaks", "heart_rate", "phase_list"])]
    pub still: bool,
    /// R-peaks in seconds from the first frame, one per line, instead of the files' ECG: one file for all runs, or the option
    /// once for each run, in the order of the runs.
    #[arg(long, value_name = "FILE", action = ArgAction::Append, conflicts_with_all = ["heart_rate", "phase_list"])]
    pub r_peaks: Vec<PathBuf>,
    /// Heart rate, beats per minute, of a regular rhythm with an R-peak at the first frame: one for all runs, or one for each.
    #[arg(long, value_name = "PER_MIN[,PER_MIN...]", value_delimiter = ',', conflicts_with = "phase_list")]
    pub heart_rate: Vec<f64>,
    /// Find the beat of each run in its images, without an ECG, and take the vessels of single frames from a background that may move. Runs
    /// are aligned with each other. A regular rhythm is assumed, over at least one and a quarter beats.
    #[arg(long, conflicts_with_all = ["still", "r_peaks", "heart_rate", "phase_list", "all_beats", "beat_scaling"])]
    pub gate_by_images: bool,
    /// Average the frames of a phase over all beats of a run. By default, each phase is taken from one beat, that with most
    /// contrast and least change by breathing, because vessels of two breaths do not coincide.
    #[arg(long, conflicts_with = "still")]
    pub all_beats: bool,
    /// Conversion of times between R-peaks to phases.
    #[arg(long, value_parser = choice::<BeatScaling>(), default_value = BeatScaling::default().name())]
    pub beat_scaling: BeatScaling,
    /// Phase (from 0) of each selected frame, one per line; a frame may lie between two phases, e.g. 3.4. One file for all runs,
    /// or the option once for each run, in the order of the runs.
    #[arg(long, value_name = "FILE", action = ArgAction::Append)]
    pub phase_list: Vec<PathBuf>,
    /// Frames of each run to use, from 1; by default those filled with contrast.
    #[arg(long, value_name = "FIRST-LAST", value_parser = frame_range)]
    pub frames: Option<std::ops::RangeInclusive<usize>>,
    /// Longest side of the images, pixels: larger images are reduced by averaging.
    #[arg(long)]
    pub size: Option<usize>,
    /// Depth range to reconstruct in front of and behind the isocentre, mm.
    #[arg(long, default_value_t = 100.0, value_name = "MM")]
    pub depth: f64,
}

/// Options of DICOM runs.
#[derive(Debug, Args)]
pub struct DicomArgs {
    /// Options of runs of any source.
    #[command(flatten)]
    pub runs: RunArgs,
    /// Pixel pitch on the detector along columns and rows, mm: one number or two.
    #[arg(long, value_name = "MM[,MM]", value_parser = pitch)]
    pub pixel_spacing: Option<[f64; 2]>,
    /// Distance from source to detector, mm, instead of the files' (0018,1110): one for all runs, or one for each.
    #[arg(long, value_name = "MM[,MM...]", value_delimiter = ',')]
    pub sid: Vec<f64>,
    /// Distance from source to isocentre, mm, instead of the files' (0018,1111): one for all runs, or one for each.
    #[arg(long, value_name = "MM[,MM...]", value_delimiter = ',')]
    pub sod: Vec<f64>,
    /// Primary and secondary angle, degrees (LAO and cranial positive), of all frames of a run, instead of the files'
    /// (0018,1510) and (0018,1511): one pair for all runs, or one for each.
    #[arg(long, value_name = "P,S[;P,S...]", allow_hyphen_values = true, value_parser = view_angles)]
    pub angles: Option<AngleList>,
}

/// Returns the value of an option for each of `n` runs: one value is that of all runs; none for an option that was not given.
pub fn for_each<T: Clone>(option: &str, values: &[T], n: usize) -> Result<Vec<Option<T>>> {
    match values {
        [] => Ok(vec![None; n]),
        [one] => Ok(vec![Some(one.clone()); n]),
        values if values.len() == n => Ok(values.iter().cloned().map(Some).collect()),
        values => {
            let problem = format!("values are given for {n} runs: one for all runs, or one for each, is needed");
            Err(Error::config(option, values.len(), problem))
        }
    }
}

impl RunArgs {
    /// Converts the options to those of the library, with the source of the phases of runs that have no other.
    ///
    /// # Errors
    /// [`Error::Config`] for an option that cannot be used.
    pub fn options(&self) -> Result<ImportOptions> {
        if !(self.depth.is_finite() && self.depth > 0.0) {
            return Err(Error::config("depth", self.depth, "is not a positive length in mm"));
        }
        Ok(ImportOptions {
            phases: self.phases,
            gating: match (self.still, self.gate_by_images) {
                (true, _) => Gating::Still,
                (_, true) => Gating::Images,
                _ => Gating::Ecg,
            },
            scaling: self.beat_scaling,
            frames: self.frames.clone(),
            pixel_mm: None,
            size: self.size,
            all_beats: self.all_beats,
            depth_half_extent_mm: self.depth,
            keep_references: false,
        })
    }

    /// Returns the sources of the phases of `n` runs; none for a run that has that of all runs.
    ///
    /// # Errors
    /// [`Error::Config`] for a number of values that does not fit; [`Error::Data`] and [`Error::Io`] for a file.
    pub fn gatings(&self, n: usize) -> Result<Vec<Option<Gating>>> {
        if !self.r_peaks.is_empty() {
            let read = |file: &PathBuf| -> Result<Gating> { Ok(Gating::RPeaks(RPeaks::new(&list::<f64>(file)?)?)) };
            let peaks = self.r_peaks.iter().map(read).collect::<Result<Vec<_>>>()?;
            return for_each("--r-peaks", &peaks, n);
        }
        if !self.phase_list.is_empty() {
            let read = |file: &PathBuf| -> Result<Gating> { Ok(Gating::Phases(list(file)?)) };
            let phases = self.phase_list.iter().map(read).collect::<Result<Vec<_>>>()?;
            return for_each("--phase-list", &phases, n);
        }
        let rates: Vec<Gating> = self.heart_rate.iter().copied().map(Gating::HeartRate).collect();
        for_each("--heart-rate", &rates, n)
    }
}

impl DicomArgs {
    /// Converts the options to those of the library.
    ///
    /// # Errors
    /// Errors of [`RunArgs::options`].
    pub fn options(&self) -> Result<ImportOptions> {
        Ok(ImportOptions { pixel_mm: self.pixel_spacing, ..self.runs.options()? })
    }

    /// Returns what the options state of each of `n` runs.
    ///
    /// # Errors
    /// Errors of [`RunArgs::gatings`].
    pub fn stated(&self, n: usize) -> Result<Vec<StatedRun>> {
        let angles = self.angles.as_ref().map_or(&[][..], |list| &list.0);
        let angles: Vec<[f64; 2]> = angles.iter().map(|a| [a.primary_deg, a.secondary_deg]).collect();
        let (sid, sod) = (for_each("--sid", &self.sid, n)?, for_each("--sod", &self.sod, n)?);
        let (angles, gatings) = (for_each("--angles", &angles, n)?, self.runs.gatings(n)?);
        let run = |i: usize| StatedRun {
            geometry: StatedGeometry { sid_mm: sid[i], sod_mm: sod[i], angles_deg: angles[i], pixel_mm: None },
            gating: gatings[i].clone(),
        };
        Ok((0..n).map(run).collect())
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
pub(crate) fn list<T: std::str::FromStr>(path: &Path) -> Result<Vec<T>> {
    let text = files::read_text(path, MAX_LIST_BYTES)?;
    let lines = text.lines().map(|l| l.split('#').next().unwrap_or_default().trim()).enumerate();
    lines
        .filter(|(_, line)| !line.is_empty())
        .map(|(i, line)| {
            line.parse().map_err(|_| Error::data(path, format!("line {}", i + 1), format!("`{line}` is not a number")))
        })
        .collect()
}
