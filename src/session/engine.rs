//! Training of a session and its source for drawing, shared by the session's threads.

use crate::calibrate::calibrate;
use crate::calibrate::correction::Calibration;
use crate::checkpoint::Checkpoint;
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::methods;
use crate::model::Model;
use crate::model::scene::Scene;
use crate::plan::Plan;
use crate::render::live::{Live, Source};
use crate::session::inbox::Inbox;
use crate::session::progress::{Observer, Progress, State};
use crate::train::trainer::Trainer;
use crate::train::training::Training;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

/// Pause after taking in new frames, as a multiple of the time that took.
const SETTLE: u32 = 4;
/// Time without a new frame that ends the pause early; so does the time that the last intake took.
const QUIET: Duration = Duration::from_millis(300);
/// Interval at which training looks again while others wait for the engine.
const GIVE_WAY: Duration = Duration::from_micros(200);

pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// State that the threads of a session share.
pub(super) struct Shared {
    pub(super) gpu: Option<Gpu>,
    pub(super) tuning: Option<Tuning>,
    pub(super) inbox: Mutex<Inbox>,
    /// Rises with every change of the inbox.
    pub(super) version: AtomicU64,
    pub(super) engine: Mutex<Engine>,
    /// Number of threads that wait for the engine, other than training in the background.
    pub(super) visitors: AtomicU32,
    pub(super) published: Mutex<Published>,
    /// Calibration of the frames that training uses; none before it begins.
    pub(super) calibration: Mutex<Option<Calibration>>,
    /// Iterations handed to the device.
    pub(super) step: AtomicU32,
    pub(super) viewer: Mutex<Option<(u64, Live)>>,
    pub(super) control: Mutex<Control>,
    pub(super) changed: Condvar,
    pub(super) stop: AtomicBool,
    pub(super) pause: AtomicBool,
}

/// The run under way.
#[derive(Default)]
pub(super) struct Engine {
    pub(super) training: Option<Training>,
    /// State to begin from where there is no trainer, and to fall back to.
    pub(super) saved: Option<Checkpoint>,
    /// Version of the inbox from which the trainer was built.
    pub(super) version: u64,
    pub(super) frames: u32,
    /// Pause before new frames are taken in.
    pub(super) settling: Option<Settling>,
}

/// Pause by which frames that come one after the other are taken in together: otherwise training would do nothing else.
#[derive(Clone, Copy)]
pub(super) struct Settling {
    /// End of the pause.
    until: Instant,
    /// Time without a new frame that ends the pause early.
    quiet: Duration,
}

/// Source that is drawn.
#[derive(Default)]
pub(super) struct Published {
    pub(super) generation: u64,
    pub(super) source: Option<Source>,
}

/// State of training, for those who wait for it.
pub(super) struct Control {
    pub(super) state: State,
    pub(super) failure: Option<String>,
    pub(super) worker: Option<ThreadId>,
    /// When frames or R-peaks came last.
    pub(super) news: Instant,
}

pub(super) fn nothing_yet() -> Error {
    Error::NotReady("there is no reconstruction yet: train first, or load a checkpoint".into())
}

impl Engine {
    /// Iterations done.
    pub(super) fn step(&self) -> u32 {
        self.training.as_ref().map_or(0, |t| t.trainer().step())
    }

    /// Counts time and iterations from now on.
    pub(super) fn start_clock(&mut self) {
        if let Some(training) = &mut self.training {
            training.start_clock();
        }
    }

    /// Number of iterations of the run.
    pub(super) fn length(&self) -> u32 {
        self.training.as_ref().map_or(0, |t| t.trainer().plan().config.train.iterations)
    }
}

impl Shared {
    pub(super) fn device(&self) -> Result<(&Gpu, &Tuning)> {
        match (&self.gpu, &self.tuning) {
            (Some(gpu), Some(tuning)) => Ok((gpu, tuning)),
            _ => Err(Error::NoDevice("the context was created without a device".into())),
        }
    }

    /// Locks the engine before training in the background takes it again.
    pub(super) fn visit(&self) -> MutexGuard<'_, Engine> {
        self.visitors.fetch_add(1, Ordering::AcqRel);
        let engine = lock(&self.engine);
        self.visitors.fetch_sub(1, Ordering::AcqRel);
        engine
    }

    pub(super) fn publish(&self, source: Source) {
        let mut published = lock(&self.published);
        published.generation += 1;
        published.source = Some(source);
    }

    pub(super) fn with_viewer<T>(&self, draw: impl FnOnce(&mut Live, u32) -> Result<T>) -> Result<T> {
        let (gpu, tuning) = self.device()?;
        gpu.looks().note();
        let mut viewer = lock(&self.viewer);
        let step = self.step.load(Ordering::Acquire);
        let (generation, source) = {
            let published = lock(&self.published);
            let current = viewer.as_ref().is_some_and(|(of, _)| *of == published.generation);
            (published.generation, if current { None } else { published.source.clone() })
        };
        if let Some(source) = source {
            // The memory of the old viewer must be free first.
            *viewer = None;
            *viewer = Some((generation, Live::new(gpu, &source, tuning.clone())?));
        }
        match &mut *viewer {
            Some((_, live)) => draw(live, step),
            None => Err(nothing_yet()),
        }
    }

    /// Brings the trainer up to the frames there are.
    pub(super) fn take_in_frames(&self, engine: &mut Engine) -> Result<()> {
        let (gpu, tuning) = self.device()?;
        let version = self.version.load(Ordering::Acquire);
        if engine.version == version && engine.training.is_some() {
            return Ok(());
        }
        let begin = Instant::now();
        let (dataset, config) = {
            let inbox = lock(&self.inbox);
            (inbox.training_dataset()?, inbox.options.config.clone())
        };
        let mut tuning = tuning.clone();
        if gpu.info().is_cpu() {
            // Views wait for what was submitted before them.
            tuning.iterations_per_submit = Some(1);
        }
        dataset.notes.iter().for_each(|note| tracing::info!("{note}"));
        let calibration = calibrate(&dataset, &config)?;
        calibration.notes.iter().for_each(|note| tracing::info!("{note}"));
        let dataset = dataset.corrected(&calibration)?;
        let fresh = Plan::new(&config, &dataset)?;
        let mut earlier = None;
        if let Some(training) = &mut engine.training {
            let mut state = training.trainer_mut().checkpoint()?;
            let fits = holds(&state.model, &fresh.scene);
            if !fits {
                tracing::warn!(
                    "new frames show vessels outside the box that was trained so far, so training starts again"
                );
                earlier = state.model.gaussians.take();
            }
            engine.saved = fits.then_some(state);
        }
        (engine.training, engine.version) = (None, 0); // its memory is needed
        let trainer = match &engine.saved {
            None => Trainer::start_over(gpu, fresh, &dataset, tuning, earlier.as_ref())?,
            Some(state) => {
                let plan = if methods::of(&config).boxes_hold_all_rays() {
                    fresh
                } else {
                    fresh.in_scene(state.model.scene.clone())
                };
                Trainer::carry_on(gpu, plan, &dataset, tuning, state)?
            }
        };
        tracing::info!("training on {} frames starts at iteration {}", dataset.training().len(), trainer.step());
        trainer.plan().notes.iter().for_each(|note| tracing::info!("{note}"));
        *lock(&self.calibration) = Some(calibration);
        engine.frames = dataset.training().len() as u32;
        engine.version = version;
        let took = begin.elapsed();
        engine.settling = Some(Settling { until: Instant::now() + took * SETTLE, quiet: took.max(QUIET) });
        self.step.store(trainer.step(), Ordering::Release);
        self.publish(Source { outline: trainer.outline(), feed: trainer.feed() });
        engine.training = Some(Training::new(trainer));
        Ok(())
    }

    /// Keeps the device busy towards `end`. After an error the last good state is shown, if there is one.
    pub(super) fn advance(&self, engine: &mut Engine, end: u32) -> Result<Option<Progress>> {
        let advanced = self.try_advance(engine, end);
        if advanced.is_err() {
            self.fall_back(engine);
        }
        advanced
    }

    fn try_advance(&self, engine: &mut Engine, end: u32) -> Result<Option<Progress>> {
        let frames = engine.frames;
        let Some(training) = &mut engine.training else { return Ok(None) };
        let before = training.trainer().step();
        let progress = training.advance(end)?;
        let trainer = training.trainer_mut();
        if let Some(large) = trainer.take_large_loss() {
            tracing::warn!("{large}");
        }
        self.step.store(trainer.submitted(), Ordering::Release);
        let config = &trainer.plan().config;
        let every = config.train.checkpoint_every;
        let progress = progress.last().map(|p| Progress {
            loss: p.loss,
            iterations: config.train.iterations,
            frames,
            psnr_db: p.psnr_db,
            iterations_per_s: p.iterations_per_s,
        });
        if before / every != trainer.step() / every {
            engine.saved = Some(trainer.checkpoint()?);
        }
        Ok(progress)
    }

    /// Lets the iterations under way finish.
    pub(super) fn drain(&self, engine: &mut Engine) -> Result<()> {
        let submitted = |engine: &Engine| engine.training.as_ref().map_or(0, |t| t.trainer().submitted());
        while engine.step() < submitted(engine) {
            self.advance(engine, submitted(engine))?;
        }
        Ok(())
    }

    fn fall_back(&self, engine: &mut Engine) {
        engine.training = None;
        engine.version = 0;
        let source = engine.saved.as_ref().map(|saved| Source::of(&saved.model));
        self.step.store(engine.saved.as_ref().map_or(0, |s| s.model.step), Ordering::Release);
        let mut published = lock(&self.published);
        published.generation += 1;
        published.source = source;
        drop(published);
        *lock(&self.viewer) = None;
    }

    fn has_settled(&self, engine: &Engine) -> bool {
        let Some(Settling { until, quiet }) = engine.settling else { return true };
        Instant::now() >= until || lock(&self.control).news.elapsed() >= quiet
    }

    pub(super) fn set_state(&self, state: State) {
        lock(&self.control).state = state;
        self.changed.notify_all();
    }

    /// Waits for a change, at most until `limit`.
    pub(super) fn rest(&self, limit: Duration, reason: impl Fn() -> bool) {
        let control = lock(&self.control);
        if reason() && !self.stop.load(Ordering::Acquire) {
            drop(self.changed.wait_timeout(control, limit).unwrap_or_else(PoisonError::into_inner));
        }
    }

    /// Runs training in the background.
    pub(super) fn work(&self, observe: &mut Observer<'_>) -> Result<State> {
        lock(&self.engine).start_clock();
        loop {
            if self.stop.load(Ordering::Acquire) {
                self.drain(&mut lock(&self.engine))?;
                return Ok(State::Idle);
            }
            if self.pause.load(Ordering::Acquire) {
                self.drain(&mut lock(&self.engine))?;
                self.set_state(State::Paused);
                self.rest(Duration::from_secs(1), || self.pause.load(Ordering::Acquire));
                lock(&self.engine).start_clock();
                continue;
            }
            while self.visitors.load(Ordering::Acquire) > 0 {
                std::thread::sleep(GIVE_WAY);
            }
            let mut engine = lock(&self.engine);
            let version = self.version.load(Ordering::Acquire);
            if engine.version != version && self.has_settled(&engine) {
                match self.take_in_frames(&mut engine) {
                    Ok(()) => (),
                    Err(Error::NotReady(why)) if engine.training.is_none() => {
                        drop(engine);
                        tracing::info!("waiting for frames: {why}");
                        self.set_state(State::Waiting);
                        self.rest(Duration::from_secs(60), || self.version.load(Ordering::Acquire) == version);
                        continue;
                    }
                    Err(error) => return Err(error),
                }
            }
            self.set_state(State::Running);
            let length = engine.length();
            let progress = self.advance(&mut engine, length)?;
            let done = engine.step() >= length && engine.version == version;
            drop(engine);
            if progress.is_some_and(|p| !observe(&p)) {
                self.drain(&mut lock(&self.engine))?;
                return Ok(State::Cancelled);
            }
            if done {
                return Ok(State::Finished);
            }
        }
    }
}

/// Tells whether fields trained in an old scene can go on in a new one: their box must hold the new one, and scales must be
/// similar. Boxes that hold all rays do not bound the fields and may grow.
fn holds(model: &Model, new: &Scene) -> bool {
    let old = &model.scene;
    let slack = 0.02 * (0..3).map(|i| old.dynamic_max[i] - old.dynamic_min[i]).fold(0.0, f64::max);
    let within =
        |i: usize| new.dynamic_min[i] >= old.dynamic_min[i] - slack && new.dynamic_max[i] <= old.dynamic_max[i] + slack;
    let inside = methods::of(&model.config).boxes_hold_all_rays() || (0..3).all(within);
    let alike = |a: f64, b: f64| a / b < 2.0 && b / a < 2.0;
    let static_alike = old.static_gain == new.static_gain || alike(old.static_gain, new.static_gain);
    inside && static_alike && alike(old.dynamic_gain, new.dynamic_gain)
}
