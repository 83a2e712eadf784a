//! One reconstruction, from a dataset to a run directory: trains, validates, saves, and can be stopped.
//!
//! A run directory holds `config.toml`, `metrics.jsonl` (one object per line), the newest checkpoints and,
//! when finished, `report/` with the evaluation and pictures.

use crate::config::Config;
use crate::data::dataset::{Dataset, Frame};
use crate::error::{Error, Result};
use crate::files;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::kernels::Tuning;
use crate::output::eval::{self, evaluate};
use crate::output::pictures::Window;
use crate::output::render::Renderer;
use crate::train::checkpoint::{self, Checkpoint};
use crate::train::plan::Plan;
use crate::train::trainer::{Snapshot, StepLoss, Trainer};
use serde::Serialize;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::time::Instant;

/// Losses are written and reported once per this many iterations.
const REPORT_EVERY: u32 = 10;

/// What a run tells its observer; also the lines of `metrics.jsonl`.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// Training begins or continues.
    Started {
        /// Device name.
        device: String,
        /// Iterations already done.
        step: u32,
        /// Length of the run.
        iterations: u32,
        /// Parameters.
        parameters: usize,
        /// Decisions about data and device.
        notes: Vec<String>,
    },
    /// Losses, every few iterations.
    Progress {
        /// Losses of the last iteration.
        #[serde(flatten)]
        loss: StepLoss,
        /// PSNR of the training rays, dB, smoothed.
        psnr: f64,
        /// Iterations per second.
        iterations_per_s: f64,
        /// Seconds of training so far, validation and saving included.
        elapsed_s: f64,
        /// Estimated seconds to the end.
        left_s: f64,
    },
    /// Metrics on some unseen images.
    Validation {
        /// Iterations done.
        step: u32,
        /// Seconds spent training until then; wall time where validation runs beside training, otherwise without it.
        train_s: f64,
        /// Dice of the dynamic field.
        dice_dynamic: Option<f64>,
        /// Dice of both fields.
        dice_total: Option<f64>,
        /// dB.
        psnr: f64,
        /// Structural similarity.
        ssim: f64,
    },
    /// A checkpoint was written.
    Saved {
        /// Iterations it holds.
        step: u32,
        /// File.
        path: PathBuf,
    },
    /// Device time of each pass of one more iteration, whose result is not kept.
    Profile {
        /// Iterations done before.
        step: u32,
        /// In order.
        passes: Vec<PassTime>,
    },
    /// The run reached its end or the requested stop.
    Finished {
        /// Iterations done.
        step: u32,
        /// Seconds spent training, validation excluded.
        train_s: f64,
        /// Seconds in all.
        elapsed_s: f64,
    },
}

/// What a run remembers of its surroundings: `run.json`.
#[derive(Debug, Clone, Serialize, serde::Deserialize)]
pub struct RunInfo {
    /// Dataset it was trained on.
    pub dataset: PathBuf,
}

impl RunInfo {
    const FILE: &str = "run.json";

    /// Writes it into a run directory.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, run: &Path) -> Result<()> {
        let text = serde_json::to_string_pretty(self).map_err(|e| Error::Internal(e.to_string()))?;
        files::write_atomic(&run.join(Self::FILE), text.as_bytes())
    }

    /// Reads it from a run directory, or from beside a checkpoint.
    ///
    /// # Errors
    /// [`Error::Io`] or [`Error::Data`].
    pub fn read(run: &Path) -> Result<RunInfo> {
        let directory = if run.is_file() { run.parent().unwrap_or(Path::new(".")) } else { run };
        let file = directory.join(Self::FILE);
        let text = std::fs::read(&file).map_err(Error::io("read", &file))?;
        serde_json::from_slice(&text).map_err(|e| Error::data(&file, "JSON", e.to_string()))
    }
}

/// How to run.
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
    let mut trainer = if options.resume {
        let saved = Checkpoint::read(&checkpoint::newest(options.run)?)?;
        let plan = Plan::new(&saved.model.config, dataset)?.in_scene(saved.model.scene.clone());
        Trainer::resume(gpu, plan, dataset, options.tuning.clone(), &saved)?
    } else {
        files::create_directory(options.run)?;
        Trainer::new(gpu, Plan::new(config, dataset)?, dataset, options.tuning.clone())?
    };
    let config = trainer.plan().config.clone();
    files::write_atomic(&options.run.join("config.toml"), config.to_toml()?.as_bytes())?;
    let mut log = MetricsLog::open(&options.run.join("metrics.jsonl"), trainer.step())?;
    let mut tell = |event: Event| -> Result<()> {
        log.write(&event)?;
        observe(&event);
        Ok(())
    };
    let mut notes = trainer.plan().notes.clone();
    notes.extend(trainer.tuning().reasons.iter().cloned());
    tell(Event::Started {
        device: gpu.info().name.clone(),
        step: trainer.step(),
        iterations: config.train.iterations,
        parameters: trainer.plan().params.len,
        notes,
    })?;
    let begin = Instant::now();
    let keeper = Keeper {
        gpu,
        tuning: options.tuning,
        run: options.run,
        dataset,
        validation: eval::spread_validation(dataset, config.train.validate_images as usize),
        begin,
    };
    std::thread::scope(|scope| {
        // At most two snapshots wait: beyond that training waits for the keeper.
        let (jobs, to_do) = sync_channel::<Job>(2);
        let (done, news) = channel::<News>();
        scope.spawn(move || keeper.work(&to_do, &done));
        Loop::new(&mut trainer, &config, options, begin, &mut tell).run(jobs, &news)
    })
}

/// What the keeper says: an event, or nothing more about a job.
type News = Result<Option<Event>>;

/// A snapshot and what to do with it.
struct Job {
    snapshot: Snapshot,
    save: bool,
    validate: bool,
    /// Seconds of training until then; none when training goes on meanwhile and only the clock tells.
    train_s: Option<f64>,
}

/// Saves and validates snapshots.
struct Keeper<'a> {
    gpu: &'a Gpu,
    tuning: &'a Tuning,
    run: &'a Path,
    dataset: &'a Dataset,
    validation: Vec<&'a Frame>,
    begin: Instant,
}

impl Keeper<'_> {
    fn work(&self, jobs: &Receiver<Job>, done: &Sender<News>) {
        let mut renderer = None;
        for job in jobs {
            let mut events = Vec::new();
            let outcome = self.handle(job, &mut renderer, &mut events);
            // A receiver that has gone away no longer wants to know.
            events.into_iter().for_each(|event| drop(done.send(Ok(Some(event)))));
            let failed = outcome.is_err();
            drop(done.send(outcome.map(|()| None)));
            if failed {
                return;
            }
        }
    }

    fn handle(&self, job: Job, renderer: &mut Option<Renderer>, events: &mut Vec<Event>) -> Result<()> {
        let saved = job.snapshot.wait()?;
        let train_s = job.train_s.unwrap_or_else(|| self.begin.elapsed().as_secs_f64());
        let step = saved.model.step;
        if job.save {
            events.push(Event::Saved { step, path: saved.save(self.run)? });
        }
        if job.validate && !self.validation.is_empty() {
            let renderer = match renderer {
                Some(renderer) => renderer,
                none => none.insert(Renderer::new(self.gpu, &saved.model, self.tuning.clone())?),
            };
            renderer.set_model(&saved.model)?;
            let score = evaluate(renderer, self.dataset, &self.validation, step, None, |_, _, _| Ok(()))?;
            events.push(Event::Validation {
                step,
                train_s,
                dice_dynamic: score.dice.dynamic,
                dice_total: score.dice.total,
                psnr: score.psnr,
                ssim: score.ssim,
            });
        }
        Ok(())
    }
}

/// Runs the iterations. Snapshots go to the keeper, which works beside training where `tuning.overlap` says so, and
/// while training waits otherwise.
struct Loop<'a> {
    trainer: &'a mut Trainer,
    config: &'a Config,
    options: &'a RunOptions<'a>,
    begin: Instant,
    tell: &'a mut dyn FnMut(Event) -> Result<()>,
    first_step: u32,
    end: u32,
    /// Span of the training images.
    range: f64,
    smoothed_mse: Option<f64>,
    train_s: f64,
    /// Jobs the keeper has not finished.
    waiting: u32,
}

impl<'a> Loop<'a> {
    fn new(
        trainer: &'a mut Trainer,
        config: &'a Config,
        options: &'a RunOptions<'a>,
        begin: Instant,
        tell: &'a mut dyn FnMut(Event) -> Result<()>,
    ) -> Loop<'a> {
        let window = Window::of(&trainer.plan().images);
        Loop {
            first_step: trainer.step(),
            end: options.stop_at.unwrap_or(config.train.iterations).min(config.train.iterations),
            range: f64::from(window.high - window.low),
            smoothed_mse: None,
            train_s: 0.0,
            waiting: 0,
            trainer,
            config,
            options,
            begin,
            tell,
        }
    }

    fn run(mut self, jobs: SyncSender<Job>, news: &Receiver<News>) -> Result<()> {
        let overlap = self.options.tuning.overlap;
        loop {
            let cancelled = self.cancelled();
            let step = self.trainer.submitted();
            let (save, validate) = (self.saves_at(step) || cancelled, self.validates_at(step) && !cancelled);
            if (save || validate) && (step > self.first_step || cancelled) {
                let train_s = (!overlap).then_some(self.train_s);
                let job = Job { snapshot: self.trainer.snapshot()?, save, validate, train_s };
                self.waiting += 1;
                if jobs.send(job).is_err() {
                    break; // the keeper failed, and says why below
                }
            }
            if !overlap {
                self.hear_all(news)?;
            }
            if cancelled || step >= self.end {
                break;
            }
            let stop = (step + 1..self.end).find(|s| self.saves_at(*s) || self.validates_at(*s)).unwrap_or(self.end);
            while self.trainer.submitted() < stop && !self.cancelled() {
                self.advance(stop)?;
                news.try_iter().try_for_each(|item| self.hear(item))?;
            }
            if !overlap || stop == self.end || self.cancelled() {
                while self.trainer.step() < self.trainer.submitted() {
                    self.advance(self.trainer.submitted())?;
                }
            }
        }
        drop(jobs);
        self.hear_all(news)?;
        if self.trainer.step() < self.end {
            return Err(Error::Interrupted);
        }
        let (step, elapsed_s) = (self.trainer.step(), self.begin.elapsed().as_secs_f64());
        (self.tell)(Event::Profile { step, passes: self.trainer.profile_step()? })?;
        (self.tell)(Event::Finished { step, train_s: self.train_s, elapsed_s })
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

    fn advance(&mut self, until: u32) -> Result<()> {
        let started = Instant::now();
        let losses = self.trainer.advance(until)?;
        self.train_s += started.elapsed().as_secs_f64();
        for loss in losses {
            let mse = self.smoothed_mse.map_or(loss.squared_error, |m| 0.95 * m + 0.05 * loss.squared_error);
            self.smoothed_mse = Some(mse);
            if loss.step.is_multiple_of(REPORT_EVERY) || loss.step == self.end {
                let elapsed_s = self.begin.elapsed().as_secs_f64();
                let rate = f64::from(loss.step - self.first_step) / elapsed_s.max(1e-9);
                (self.tell)(Event::Progress {
                    loss,
                    psnr: -10.0 * (mse / (self.range * self.range)).max(1e-20).log10(),
                    iterations_per_s: rate,
                    elapsed_s,
                    left_s: f64::from(self.end - loss.step) / rate,
                })?;
            }
        }
        Ok(())
    }

    fn hear(&mut self, item: News) -> Result<()> {
        match item? {
            Some(event) => (self.tell)(event),
            None => {
                self.waiting -= 1;
                Ok(())
            }
        }
    }

    fn hear_all(&mut self, news: &Receiver<News>) -> Result<()> {
        while self.waiting > 0 {
            let item = news.recv().map_err(|_| Error::Internal("the keeper of snapshots is gone".into()))?;
            self.hear(item)?;
        }
        Ok(())
    }
}

/// `metrics.jsonl`: appended line by line; on resume, lines beyond the resumed step are dropped first.
struct MetricsLog {
    path: PathBuf,
    file: std::fs::File,
}

impl MetricsLog {
    fn open(path: &Path, step: u32) -> Result<MetricsLog> {
        let old = if step == 0 { String::new() } else { std::fs::read_to_string(path).unwrap_or_default() };
        let kept: String = old
            .lines()
            .filter(|line| {
                serde_json::from_str::<serde_json::Value>(line)
                    .is_ok_and(|v| v["step"].as_u64().is_some_and(|s| s <= u64::from(step)))
            })
            .flat_map(|line| [line, "\n"])
            .collect();
        files::write_atomic(path, kept.as_bytes())?;
        let file = std::fs::OpenOptions::new().append(true).open(path).map_err(Error::io("append to", path))?;
        Ok(MetricsLog { path: path.to_path_buf(), file })
    }

    fn write(&mut self, event: &Event) -> Result<()> {
        let line = serde_json::to_string(event).map_err(|e| Error::Internal(e.to_string()))? + "\n";
        self.file.write_all(line.as_bytes()).map_err(Error::io("append to", &self.path))
    }
}
