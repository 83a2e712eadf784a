//! What `watch` leaves in the end: a run directory as `train` does, with the runs it was made of as a dataset.

use super::report::Report;
use nertca_vk::calibrate::correction::Calibration;
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::import::intake::Intake;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::checkpoint::{self, Checkpoint};
use nertca_vk::run::info::RunInfo;
use nertca_vk::run::score::as_trained;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::session::Session;
use nertca_vk::train::trainer::data_fingerprint;
use std::path::{Path, PathBuf};

/// Dataset of the runs that were taken in, inside the run directory.
const DATA: &str = "data";
/// The same while it is written.
const PARTIAL_DATA: &str = ".partial-data";

/// Makes a run directory, or refuses one that holds something already or cannot be written to.
pub fn prepare(run: &Path) -> Result<()> {
    if run.exists() {
        let log = run.join("metrics.jsonl");
        let checkpoint = checkpoint::list(run)?.pop().map(|(_, path)| path);
        if let Some(old) = checkpoint.into_iter().chain([log, run.join(DATA)]).find(|path| path.exists()) {
            let problem = format!("already holds `{}`: choose another directory", old.display());
            return Err(Error::config("--out", run.display(), problem));
        }
    }
    files::create_directory(run)?;
    tempfile::tempfile_in(run).map_err(Error::io("create a temporary file in", run))?;
    Ok(())
}

/// Removes a run directory that nothing was left in.
pub fn remove_empty(run: &Path) {
    // One that is not empty stays.
    let _ = std::fs::remove_dir(run);
}

/// What training has come to.
pub struct Kept {
    checkpoint: Checkpoint,
    calibration: Option<Calibration>,
    /// Runs that were handed to training, of which it may not have taken in the last ones.
    runs: usize,
}

impl Kept {
    /// Stops training, which was handed so many runs, and keeps what it has come to.
    ///
    /// # Errors
    /// [`Error::NotReady`] where that is nothing; device errors.
    pub fn of(session: &Session, runs: usize) -> Result<Kept> {
        session.stop()?;
        Ok(Kept { checkpoint: session.checkpoint()?, calibration: session.calibration(), runs })
    }

    /// Whether this is better than what was kept before: training that has barely begun anew is not, even with more runs.
    pub fn replaces(&self, before: &Kept) -> bool {
        2 * self.checkpoint.model.step >= before.checkpoint.model.step
    }

    /// Iterations done.
    pub fn step(&self) -> u32 {
        self.checkpoint.model.step
    }

    /// Leaves a run directory; the checkpoint in it. What cannot be made again is written first.
    ///
    /// # Errors
    /// [`Error::Io`]; device errors of the report, which comes last.
    pub fn leave(&self, intake: &Intake, (gpu, tuning): (&Gpu, &Tuning), run: &Path) -> Result<PathBuf> {
        let model = &self.checkpoint.model;
        let saved = self.checkpoint.save(run)?;
        files::write_atomic(&run.join("config.toml"), model.config.to_toml()?.as_bytes())?;
        if let Some(calibration) = &self.calibration {
            calibration.write(run)?;
        }
        let data = self.write_data(intake, run)?;
        RunInfo { dataset: data.canonicalize().unwrap_or_else(|_| data.clone()) }.write(run)?;
        Report {
            gpu,
            tuning,
            model,
            dataset: &as_trained(Dataset::open(&data)?, run)?,
            evaluation: None,
            warnings: &[],
            tree: None,
            run,
            pictures: Path::new(""),
        }
        .write(&run.join("report.html"))?;
        Ok(saved)
    }

    /// Writes the runs that were trained on as a dataset.
    fn write_data(&self, intake: &Intake, run: &Path) -> Result<PathBuf> {
        let (partial, data) = (run.join(PARTIAL_DATA), run.join(DATA));
        for runs in (1..=self.runs).rev() {
            let told = write_anew(intake, runs, &partial)?;
            if self.was_trained_on(&partial)? {
                eprintln!("{told}");
                if runs < intake.runs() {
                    let all = intake.runs();
                    eprintln!(
                        "what is left was made of the first {runs} of {all} runs: later ones came too late for it"
                    );
                }
                std::fs::rename(&partial, &data).map_err(Error::io("rename into place", &data))?;
                return Ok(data);
            }
        }
        eprintln!("{}", write_anew(intake, self.runs, &partial)?);
        eprintln!("warning: {} is not exactly what was trained on: `train --resume` will refuse it", data.display());
        std::fs::rename(&partial, &data).map_err(Error::io("rename into place", &data))?;
        Ok(data)
    }

    /// Whether a dataset is what the checkpoint was trained on.
    fn was_trained_on(&self, data: &Path) -> Result<bool> {
        let dataset = Dataset::open(data)?;
        let corrected = match &self.calibration {
            // That of more views does not fit.
            Some(calibration) => dataset.corrected(calibration).ok(),
            None => Some(dataset),
        };
        Ok(corrected.is_some_and(|dataset| data_fingerprint(&dataset) == self.checkpoint.data_fingerprint))
    }
}

/// Writes the first runs in place of what is there.
fn write_anew(intake: &Intake, runs: usize, data: &Path) -> Result<String> {
    if data.exists() {
        std::fs::remove_dir_all(data).map_err(Error::io("remove", data))?;
    }
    intake.write_first(runs, data)
}
