//! One reconstruction, from a dataset to a run directory: trains, validates, saves, and can be stopped.
//!
//! A run directory holds `config.toml`, `metrics.jsonl` (one object per line), the newest checkpoints, `calibration.json`
//! with what was corrected of the views' geometry and, when finished, `report/` with the evaluation and pictures.

use crate::calibrate::choose::Correction;
use crate::calibrate::correction::Calibration;
use crate::calibrate::gauge::RigidMotion;
use crate::check;
use crate::checkpoint::{self, Checkpoint};
use crate::config::Config;
use crate::error::{Error, Result};
use crate::files;
use crate::fitting::fit::{MadeFit, Start};
use crate::fitting::losses::LargeLoss;
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::methods;
use crate::plan::Plan;
use crate::prepare::Prepared;
use crate::run::curve::{VALIDATION_IMAGES, thinned, validation_step};
use crate::run::events::{Event, Stage, StageClock, StageTime};
use crate::run::log::MetricsLog;
use crate::run::snapshots::{Answer, Job, SnapshotWorker};
use crate::run::{hull_pictures, silhouette_pictures};
use crate::scan::dataset::Dataset;
use crate::score::calibrated::{carried_by, in_calibrated_frame};
use crate::score::distance::Distance;
use crate::score::eval;
use crate::train::trainer::Trainer;
use crate::train::training::{Progress, Training};
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, channel, sync_channel};
use std::time::Instant;

/// File of a run's configuration, in the run directory.
pub const CONFIG: &str = "config.toml";
/// Losses are written and reported once per this many iterations.
const REPORT_EVERY: u32 = 10;

/// Options of a run.
pub struct RunOptions<'a> {
    /// Run directory.
    pub run: &'a Path,
    /// Continue from the newest checkpoint.
    pub resume: bool,
    /// Stop (and save) after this many iterations, leaving schedules as they are.
    pub stop_at: Option<u32>,
    /// Paths through the kernels.
    pub tuning: &'a Tuning,
    /// Set to true to stop after the iterations in flight.
    pub cancel: &'a AtomicBool,
}

/// Runs a reconstruction.
///
/// # Errors
/// [`Error::Interrupted`] after a cancel (state is saved), [`Error::Diverged`] (the last good checkpoint is
/// kept), and all errors of data and device.
pub fn reconstruct(
    gpu: &Gpu,
    config: &Config,
    dataset: &Dataset,
    options: &RunOptions<'_>,
    observe: &mut dyn FnMut(&Event),
) -> Result<()> {
    // The fits of an adjustment and those of a mean need the same pipelines.
    let _pipelines = gpu.keep_pipelines();
    // Files that an earlier process on this run was writing when it was killed are removed.
    for directory in [options.run, &options.run.join("report")] {
        files::remove_partial(directory);
    }
    if !options.resume {
        // A run that is killed before its first checkpoint is started over with its own configuration.
        files::create_directory(options.run)?;
        files::write_atomic(&options.run.join(CONFIG), config.to_toml()?.as_bytes())?;
    }
    let max_buffer = u64::from(gpu.info().max_storage_buffer_range);
    let abilities = methods::of(config).abilities;
    if let Some(memory) = abilities.estimate_memory.and_then(|estimate| estimate(config, dataset, max_buffer)) {
        let mib = |bytes: u64| bytes >> 20;
        observe(&Event::Memory {
            host_mib: mib(memory.host_bytes),
            device_mib: mib(memory.device_bytes),
            together_mib: mib(memory.together_bytes),
        });
    }
    let (mut clock, mut stages) = (StageClock::start(), Vec::new());
    let checked = if options.resume { None } else { checked(dataset) };
    let Calibrated { dataset, carried, calibration, made } = calibrated(gpu, config, dataset, options, observe)?;
    let dataset = &dataset;
    stages.push(clock.end(Stage::Calibrate));
    let trainer = if options.resume {
        let saved = Checkpoint::read(&checkpoint::newest(options.run)?)?;
        let plan = Plan::new(&saved.model.config, dataset)?.in_scene(saved.model.scene.clone());
        stages.push(clock.end(Stage::Plan));
        Trainer::resume(gpu, plan, dataset, options.tuning.clone(), &saved)?
    } else {
        // What is wrong with the views is often the reason why there is nothing to plan.
        let plan = Plan::new(config, dataset).inspect_err(|_| checked.iter().for_each(&mut *observe))?;
        if let Some(hull) = &plan.hull {
            hull_pictures::write(&options.run.join("report"), dataset, hull)?;
        }
        stages.push(clock.end(Stage::Plan));
        let from = Start { made: made.as_ref(), ..Start::default() };
        Trainer::begin(gpu, plan, dataset, options.tuning.clone(), from)?
    };
    let config = trainer.plan().config.clone();
    files::write_atomic(&options.run.join(CONFIG), config.to_toml()?.as_bytes())?;
    let mut log = MetricsLog::open(&options.run.join("metrics.jsonl"), trainer.step())?;
    let mut tell = |event: Event| -> Result<()> {
        log.write(&event)?;
        observe(&event);
        Ok(())
    };
    let mut notes = dataset.notes.clone();
    notes.extend(calibration.notes);
    notes.extend(trainer.plan().notes.iter().cloned());
    notes.extend(trainer.tuning().reasons.iter().cloned());
    let step = validation_step(&config, dataset);
    let thin = (step > 1).then(|| thinned(dataset, step));
    if step > 1 {
        notes.push(format!(
            "validation during training renders one of {step} x {step} pixels and measures no distances: with all, it would evaluate the \
             network more than a tenth as often as training does; the scores of the finished run use all pixels"
        ));
    }
    let measured = if step > 1 { Ok(None) } else { Distance::new(dataset, carried.as_ref()) };
    let distance = match measured {
        // Images are scored nevertheless.
        Err(error @ (Error::Data { .. } | Error::Io { .. })) => {
            notes.push(format!("distances to the true vessels are not measured during training: {error}"));
            None
        }
        distance => distance?,
    };
    tell(Event::Started {
        device: gpu.info().name.clone(),
        step: trainer.step(),
        iterations: config.train.iterations,
        parameters: trainer.plan().params.len,
        notes,
    })?;
    checked.map_or(Ok(()), &mut tell)?;
    stages.push(clock.end(Stage::Prepare));
    let mut training = Training::new(trainer);
    let begin = Instant::now();
    let worker = SnapshotWorker {
        gpu,
        tuning: options.tuning,
        run: options.run,
        dataset: thin.as_ref().unwrap_or(dataset),
        validation: eval::spread_validation(thin.as_ref().unwrap_or(dataset), VALIDATION_IMAGES),
        distance,
        begin,
        network_begins: config.fields().filter(|fields| fields.network.is_some()).map(|fields| fields.dynamic.delay),
        cancel: options.cancel,
    };
    std::thread::scope(|scope| {
        // At most two snapshots wait: beyond that training waits for the worker.
        let (jobs, to_do) = sync_channel::<Job>(2);
        let (done, answers) = channel::<Answer>();
        scope.spawn(move || worker.work(&to_do, &done));
        Loop::new(&mut training, &config, options, (clock, stages), &mut tell).run(jobs, &answers)
    })
}

/// Compares the views; `None` where too few of them show what moves.
fn checked(dataset: &Dataset) -> Option<Event> {
    let check = check::compare(dataset)?;
    Some(Event::Checked { step: 0, conclusion: check.conclusion(), check: Box::new(check) })
}

/// Dataset and calibration of a run.
struct Calibrated {
    /// Dataset with the corrected geometry; unseen images lie where the reconstruction has them.
    dataset: Dataset,
    /// Rigid motion of the reconstruction against the truth, where that is known.
    carried: Option<RigidMotion>,
    calibration: Calibration,
    /// Fit that the adjustment of views has left.
    made: Option<MadeFit>,
}

/// Returns the dataset with the geometry of the run: calibrated now, or when the run was begun.
fn calibrated(
    gpu: &Gpu,
    config: &Config,
    dataset: &Dataset,
    options: &RunOptions<'_>,
    observe: &mut dyn FnMut(&Event),
) -> Result<Calibrated> {
    let Prepared { calibration, made } = if options.resume {
        Prepared::known(Calibration::read(options.run)?.unwrap_or_else(|| Calibration::none(None)))
    } else {
        let mut shown = None;
        let mut observe = |share: f64| {
            if options.cancel.load(Ordering::Relaxed) {
                return Err(Error::Interrupted);
            }
            if shown.replace(share) != Some(share) {
                observe(&Event::Adjusting { share });
            }
            Ok(())
        };
        let views = Prepared::calibrated(dataset, config.calibration())?;
        let views = views.adjusted(gpu, config, dataset, &mut observe)?;
        views.calibration.write(options.run)?;
        views
    };
    let corrected = dataset.corrected(&calibration)?;
    if !options.resume && calibration.correction != Correction::Stated {
        silhouette_pictures::write(&options.run.join("report"), dataset, &corrected)?;
    }
    let carried = carried_by(&corrected)?;
    Ok(Calibrated { dataset: in_calibrated_frame(&corrected)?.unwrap_or(corrected), carried, calibration, made })
}

/// Runs the iterations. Snapshots go to the worker, which works beside training where `tuning.overlap` says so, and
/// while training waits otherwise.
struct Loop<'a> {
    training: &'a mut Training,
    config: &'a Config,
    options: &'a RunOptions<'a>,
    tell: &'a mut dyn FnMut(Event) -> Result<()>,
    /// Clock of the stages, and those that have ended.
    clock: StageClock,
    stages: Vec<StageTime>,
    first_step: u32,
    end: u32,
    /// Jobs the worker has not finished.
    waiting: u32,
    /// Dynamic share of the last reported iteration.
    dynamic_share: Option<f64>,
}

impl<'a> Loop<'a> {
    fn new(
        training: &'a mut Training,
        config: &'a Config,
        options: &'a RunOptions<'a>,
        (clock, stages): (StageClock, Vec<StageTime>),
        tell: &'a mut dyn FnMut(Event) -> Result<()>,
    ) -> Loop<'a> {
        Loop {
            first_step: training.trainer().step(),
            end: options.stop_at.unwrap_or(config.train.iterations).min(config.train.iterations),
            waiting: 0,
            dynamic_share: None,
            training,
            config,
            options,
            tell,
            clock,
            stages,
        }
    }

    fn run(mut self, jobs: SyncSender<Job>, answers: &Receiver<Answer>) -> Result<()> {
        let overlap = self.options.tuning.overlap;
        loop {
            let cancelled = self.cancelled();
            let step = self.training.trainer().submitted();
            let (save, validate) = (self.saves_at(step) || cancelled, self.validates_at(step) && !cancelled);
            if (save || validate) && (step > self.first_step || cancelled) {
                let train_s = (!overlap).then_some(self.training.train_s());
                let job = Job { snapshot: self.training.trainer().snapshot()?, save, validate, train_s };
                self.waiting += 1;
                if jobs.send(job).is_err() {
                    break; // the worker failed, and says why below
                }
            }
            if !overlap {
                self.await_answers(answers)?;
            }
            if cancelled || step >= self.end {
                break;
            }
            let stop = (step + 1..self.end).find(|s| self.saves_at(*s) || self.validates_at(*s)).unwrap_or(self.end);
            while self.training.trainer().submitted() < stop && !self.cancelled() {
                if let Some(share) = self.training.trainer().preparation() {
                    (self.tell)(Event::Preparing { share })?;
                }
                let progress = self.training.advance(stop)?;
                self.report(progress)?;
                answers.try_iter().try_for_each(|answer| self.take(answer))?;
            }
            if !overlap || stop == self.end || self.cancelled() {
                let progress = self.training.drain()?;
                self.report(progress)?;
            }
        }
        drop(jobs);
        self.await_answers(answers)?;
        if self.training.trainer().step() < self.end {
            return Err(Error::Interrupted);
        }
        let (step, elapsed_s) = (self.training.trainer().step(), self.training.elapsed_s());
        (self.tell)(Event::Profile { step, passes: self.training.trainer_mut().profile_step()? })?;
        let (train_s, dynamic_share) = (self.training.train_s(), self.dynamic_share);
        let agreement = self.training.trainer().outline().gaussians;
        let agreement = agreement.and_then(|field| field.rows().agreement.as_ref().map(|fits| fits.overall));
        self.stages.push(self.clock.end(Stage::Iterate));
        (self.tell)(Event::Finished { agreement, step, train_s, elapsed_s, dynamic_share, stages: self.stages })
    }

    fn cancelled(&self) -> bool {
        self.options.cancel.load(Ordering::Relaxed)
    }

    fn saves_at(&self, step: u32) -> bool {
        step == self.end || step.is_multiple_of(self.config.train.checkpoint_every)
    }

    fn validates_at(&self, step: u32) -> bool {
        let every = self.config.train.validate_every;
        every > 0 && (step == self.end || step.is_multiple_of(every))
    }

    /// Reports every few iterations, and the last.
    fn report(&mut self, progress: Vec<Progress>) -> Result<()> {
        if let Some(LargeLoss { step, loss, ratio }) = self.training.trainer_mut().take_large_loss() {
            (self.tell)(Event::LargeLoss { step, loss, ratio })?;
        }
        let step = self.training.trainer().step();
        for note in self.training.trainer_mut().take_findings() {
            (self.tell)(Event::Found { step, note })?;
        }
        for p in progress {
            if p.loss.step.is_multiple_of(REPORT_EVERY) || p.loss.step == self.end {
                let empty = self.training.trainer().plan().empty_loss;
                self.dynamic_share = empty.filter(|empty| *empty > 0.0).map(|empty| p.loss.dynamic / empty);
                (self.tell)(Event::Progress {
                    dynamic_share: self.dynamic_share,
                    loss: p.loss,
                    psnr: p.smoothed_psnr_db,
                    iterations_per_s: p.iterations_per_s,
                    elapsed_s: p.elapsed_s,
                    left_s: f64::from(self.end - p.loss.step) / p.iterations_per_s,
                })?;
            }
        }
        Ok(())
    }

    fn take(&mut self, answer: Answer) -> Result<()> {
        match answer? {
            Some(event) => (self.tell)(event),
            None => {
                self.waiting -= 1;
                Ok(())
            }
        }
    }

    fn await_answers(&mut self, answers: &Receiver<Answer>) -> Result<()> {
        while self.waiting > 0 {
            let gone = |_| Error::Internal("the thread that saves snapshots has ended".into());
            self.take(answers.recv().map_err(gone)?)?;
        }
        Ok(())
    }
}
