//! One run of a study, from its data to its result.

use crate::events::StudyEvent;
use crate::outcome::{CurvePoint, Outcome, RESULT, Results, RunScores, Seconds, run_directory};
use crate::plan::{Run, RunFingerprint, Study};
use nertca_vk::checkpoint::{self, newest_model};
use nertca_vk::config::Config;
use nertca_vk::error::{Error, Result};
use nertca_vk::files::{self, Lock};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::Model;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk_runs::run::events::Event;
use nertca_vk_runs::run::history::History;
use nertca_vk_runs::run::info::RunInfo;
use nertca_vk_runs::run::reconstruct::{RunOptions, reconstruct};
use nertca_vk_runs::run::score::{ScoreOptions, as_trained, evaluate_model};
use nertca_vk_vessels::score::calibrated::in_calibrated_frame;
use nertca_vk_vessels::score::eval::rendered;
use nertca_vk_vessels::score::pictures;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;
use std::time::Instant;

/// Name of the file that is written first into a run directory; it holds the run's fingerprint.
const FINGERPRINT: &str = "fingerprint.json";

/// Opens a device for one run.
pub type Open<'a> = &'a dyn Fn() -> Result<Gpu>;
/// Checks a device after its run.
pub type Close<'a> = &'a dyn Fn(&Gpu) -> Result<()>;
/// Selects kernel variants for a device.
pub type Tune<'a> = &'a dyn Fn(&Gpu, &Config, &Dataset) -> Result<Tuning>;
/// Receives events.
pub type Observe<'a> = &'a mut dyn FnMut(&StudyEvent<'_>);

/// Resources and options of the work on runs.
pub struct Workplace<'a> {
    /// Results in the directory of the study.
    pub results: Results<'a>,
    /// Opens the device of a run. Each run opens its own, so that a lost device affects no other run.
    pub open: Open<'a>,
    /// Checks the device after its run; an error ends the work.
    pub close: Close<'a>,
    /// Selects kernel variants for the run.
    pub tune: Tune<'a>,
    /// Flag that stops the work after the iterations in flight when it is true.
    pub cancel: &'a AtomicBool,
    /// Whether failed runs are repeated.
    pub retry_failed: bool,
    /// Whether results of other commits of the program count as done if data and configuration are equal.
    pub any_commit: bool,
}

/// Picture file in a run directory that compares truth and prediction for the first unseen image.
pub fn picture_file(run: &Path) -> PathBuf {
    run.join("report/first-unseen.png")
}

/// Tells whether an error is unrelated to the run itself, so that the run may succeed at another time or on another machine.
fn will_pass(error: &Error) -> bool {
    match error {
        Error::Interrupted | Error::NoDevice(_) | Error::DeviceLost { .. } | Error::Busy(_) => true,
        Error::OutOfMemory { may_pass, .. } => *may_pass,
        _ => false,
    }
}

impl Workplace<'_> {
    /// Result of a run that need not be repeated.
    ///
    /// # Errors
    /// Errors of [`Results::read`].
    pub fn done(&self, study: &Study, run: &Run) -> Result<Option<Outcome>> {
        let outcome = self.results.of(study, run, self.any_commit)?;
        Ok(outcome.filter(|outcome| outcome.failure.is_none() || !self.retry_failed))
    }

    /// Does a run, resumes one that was interrupted, or returns an existing result. A run that fails because of its own error
    /// also has a result, which states the reason. Afterwards the result is in the directory of the run, also where it was a line of
    /// `results.jsonl` before.
    ///
    /// # Errors
    /// [`Error::Interrupted`] after a cancel; [`Error::Busy`] while another process works on the run; temporary problems: a
    /// lost device, memory occupied by others, no device; errors of writing results.
    pub fn work(&self, study: &Study, run: &Run, observe: Observe<'_>) -> Result<Outcome> {
        let Some(_alone) = Lock::take(&self.results.directory.join("locks").join(format!("run-{}", run.id)))? else {
            return Err(Error::Busy(format!("another process is executing the run {}", run.id)));
        };
        let directory = run_directory(self.results.directory, run);
        if let Some(outcome) = self.done(study, run)? {
            if !directory.join(RESULT).exists() {
                outcome.write(&directory)?;
            }
            return Ok(outcome);
        }
        let fingerprint = study.fingerprint(run)?;
        let mut outcome = Outcome::new(run, fingerprint);
        let gpu = (self.open)()?;
        outcome.device.clone_from(&gpu.info().name);
        outcome.driver.clone_from(&gpu.info().driver);
        let resume = make_room(&directory, &outcome.fingerprint)?;
        let begin = Instant::now();
        match self.attempt(&gpu, study, run, resume, observe) {
            Ok(scores) => outcome.scores = Some(scores),
            Err(error) if will_pass(&error) => return Err(error),
            Err(error) => outcome.failure = Some(error.to_string()),
        }
        (self.close)(&gpu)?;
        let history = History::read(&directory);
        outcome.iterations = checkpoint::list(&directory)?.last().map_or(0, |(step, _)| *step);
        outcome.seconds = Seconds {
            training: history.train_s,
            whole: history.before_s + begin.elapsed().as_secs_f64(),
            parts: history.parts,
        };
        outcome.curve = history.curve.iter().map(CurvePoint::of).collect();
        outcome.write(&directory)?;
        Ok(outcome)
    }

    fn attempt(&self, gpu: &Gpu, study: &Study, run: &Run, resume: bool, observe: Observe<'_>) -> Result<RunScores> {
        let directory = run_directory(self.results.directory, run);
        let id = run.id.as_str();
        let data =
            study.data[run.data].prepare(gpu, self.results.directory, run.seed, self.cancel, |what, done, of| {
                observe(&StudyEvent::Making { run: id, what, done, of });
            })?;
        let dataset = Dataset::open(&data)?;
        RunInfo::new(&data).write(&directory)?;
        let config = study.config(run);
        let tuning = (self.tune)(gpu, &config, &dataset)?;
        let options = RunOptions { run: &directory, resume, stop_at: None, tuning: &tuning, cancel: self.cancel };
        reconstruct(gpu, &config, &dataset, &options, &mut |event| observe(&StudyEvent::Run { run: id, event }))?;
        let (model, dataset) = (newest_model(&directory)?, as_trained(dataset, &directory)?);
        let scoring = ScoreOptions { threshold_per_mm: None, pictures: None, cancel: self.cancel };
        let mut pace = RenderingPace { images: dataset.validation().len(), ..RenderingPace::default() };
        let evaluation = evaluate_model(gpu, &tuning, &model, &dataset, &scoring, &mut |event| {
            pace.hear(event);
            observe(&StudyEvent::Run { run: id, event });
        })?;
        let text = files::pretty_json(&evaluation)?;
        files::write_atomic(&directory.join("report/evaluation.json"), text.as_bytes())?;
        let threshold_per_mm = evaluation.threshold.dynamic_per_mm;
        first_picture(gpu, &tuning, &model, &dataset, threshold_per_mm, &picture_file(&directory))?;
        Ok(RunScores::new(&evaluation, pace.fps()))
    }
}

/// Prepares a run directory and returns whether it holds checkpoints of the same run to resume from. The files of another run
/// are removed.
fn make_room(directory: &Path, fingerprint: &RunFingerprint) -> Result<bool> {
    let file = directory.join(FINGERPRINT);
    let found = std::fs::read(&file).ok().and_then(|text| serde_json::from_slice::<RunFingerprint>(&text).ok());
    if found.as_ref() == Some(fingerprint) {
        let result = directory.join(RESULT);
        if result.exists() {
            std::fs::remove_file(&result).map_err(Error::io("remove", &result))?;
        }
        return Ok(!checkpoint::list(directory)?.is_empty());
    }
    if directory.exists() {
        std::fs::remove_dir_all(directory).map_err(Error::io("remove", directory))?;
    }
    files::write_atomic(&file, files::pretty_json(fingerprint)?.as_bytes())?;
    Ok(false)
}

/// Measures the rendering rate of the unseen images of an evaluation.
#[derive(Default)]
struct RenderingPace {
    /// Number of scored images.
    images: usize,
    /// Time at which the first image was complete, seconds; the first image also includes the creation of pipelines.
    first_s: f64,
    last_s: f64,
}

impl RenderingPace {
    fn hear(&mut self, event: &Event) {
        if let Event::Evaluation { images, elapsed_s, .. } = event {
            match *images {
                1 => self.first_s = *elapsed_s,
                n if n == self.images => self.last_s = *elapsed_s,
                _ => (),
            }
        }
    }

    /// Images per second; none for fewer than two images.
    fn fps(&self) -> Option<f64> {
        let seconds = self.last_s - self.first_s;
        (self.images > 1 && seconds > 0.0).then(|| (self.images - 1) as f64 / seconds)
    }
}

fn first_picture(
    gpu: &Gpu,
    tuning: &Tuning,
    model: &Model,
    dataset: &Dataset,
    threshold_per_mm: f64,
    path: &Path,
) -> Result<()> {
    let carried = in_calibrated_frame(dataset)?;
    let dataset = carried.as_ref().unwrap_or(dataset);
    let Some(frame) = dataset.validation().first() else { return Ok(()) };
    let renderer = Renderer::new(gpu, model, tuning.clone())?;
    let seen = rendered(&renderer, dataset, frame)?;
    let threshold = threshold_per_mm * nertca_vk::geometry::MM_PER_UNIT;
    let width = dataset.views[frame.view].size[0];
    pictures::write_comparison(path, &dataset.own_frame(frame), &seen, threshold, width)
}
