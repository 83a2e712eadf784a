//! The result of `watch`: a run directory like that of `train`, with the runs it was made from as a dataset.

use crate::command::train::{LOCK, take_run};
use crate::pages::report::Report;
use nertca_vk::calibrate::correction::Calibration;
use nertca_vk::checkpoint::{self, Checkpoint};
use nertca_vk::error::{Error, Result};
use nertca_vk::files::{self, Lock};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::trainer::data_fingerprint;
use nertca_vk_import::intake::Intake;
use nertca_vk_runs::run::info::RunInfo;
use nertca_vk_runs::run::score::as_trained;
use nertca_vk_runs::session::Session;
use std::path::{Path, PathBuf};

/// Name of the dataset of the runs that were read, inside the run directory.
const DATA: &str = "data";
/// Name of this dataset while it is being written.
const PARTIAL_DATA: &str = ".partial-data";

/// Makes a run directory and takes it for this process. Fails if it already holds a run or cannot be written to, or while another
/// process trains into it.
pub fn prepare(run: &Path) -> Result<Lock> {
    check_unused(run)?;
    files::create_directory(run)?;
    tempfile::tempfile_in(run).map_err(Error::io("create a temporary file in", run))?;
    let lock = take_run(run)?;
    // A process that had it before may have written a run meanwhile.
    check_unused(run)?;
    Ok(lock)
}

fn check_unused(run: &Path) -> Result<()> {
    if !run.exists() {
        return Ok(());
    }
    let log = run.join("metrics.jsonl");
    let checkpoint = checkpoint::list(run)?.pop().map(|(_, path)| path);
    match checkpoint.into_iter().chain([log, run.join(DATA)]).find(|path| path.exists()) {
        Some(old) => {
            let problem = format!("already contains `{}`: choose another directory", old.display());
            Err(Error::config("--out", run.display(), problem))
        }
        None => Ok(()),
    }
}

/// Removes a run directory that holds nothing but its lock, which this process has.
pub fn remove_empty(run: &Path) {
    let lock = run.join(LOCK);
    let is_other = |entry: std::io::Result<std::fs::DirEntry>| entry.is_ok_and(|entry| entry.path() != lock);
    if std::fs::read_dir(run).is_ok_and(|mut entries| !entries.any(is_other)) {
        // What cannot be removed stays.
        let _ = std::fs::remove_file(&lock);
        let _ = std::fs::remove_dir(run);
    }
}

/// Result of training.
pub struct TrainedRun {
    checkpoint: Checkpoint,
    calibration: Option<Calibration>,
    /// Number of runs handed to training; it may not have taken in the last ones.
    runs: usize,
}

impl TrainedRun {
    /// Stops training, which was handed `runs` runs, and keeps its result.
    ///
    /// # Errors
    /// [`Error::NotReady`] where there is no result; device errors.
    pub fn of(session: &Session, runs: usize) -> Result<TrainedRun> {
        session.stop()?;
        Ok(TrainedRun { checkpoint: session.checkpoint()?, calibration: session.calibration(), runs })
    }

    /// Tells whether this result is better than `before`. A training that has barely started again is not, even with more runs.
    pub fn replaces(&self, before: &TrainedRun) -> bool {
        2 * self.checkpoint.model.step >= before.checkpoint.model.step
    }

    /// Returns the number of iterations done.
    pub fn step(&self) -> u32 {
        self.checkpoint.model.step
    }

    /// Writes a run directory and returns the checkpoint in it. Files that cannot be made again are written first.
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
        RunInfo::new(&data).write(run)?;
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
                        "the reconstruction was made from the first {runs} of {all} runs; later runs came too late"
                    );
                }
                std::fs::rename(&partial, &data).map_err(Error::io("rename into place", &data))?;
                return Ok(data);
            }
        }
        eprintln!("{}", write_anew(intake, self.runs, &partial)?);
        eprintln!(
            "warning: {} is not exactly the dataset of the training, so `train --resume` will refuse it",
            data.display()
        );
        std::fs::rename(&partial, &data).map_err(Error::io("rename into place", &data))?;
        Ok(data)
    }

    /// Tells whether a dataset is the one that the checkpoint was trained on.
    fn was_trained_on(&self, data: &Path) -> Result<bool> {
        let dataset = Dataset::open(data)?;
        let corrected = match &self.calibration {
            // A calibration of a different number of views does not fit.
            Some(calibration) => dataset.corrected(calibration).ok(),
            None => Some(dataset),
        };
        Ok(corrected.is_some_and(|dataset| data_fingerprint(&dataset) == self.checkpoint.data_fingerprint))
    }
}

/// Replaces a dataset by the first `runs` runs.
fn write_anew(intake: &Intake, runs: usize, data: &Path) -> Result<String> {
    if data.exists() {
        std::fs::remove_dir_all(data).map_err(Error::io("remove", data))?;
    }
    intake.write_first(runs, data)
}
