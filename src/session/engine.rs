//! Training of a session and its source for drawing, shared by the session's threads.

use crate::calibrate::calibrate;
use crate::calibrate::correction::Calibration;
use crate::checkpoint::Checkpoint;
use crate::error::{Error, Result};
use crate::fitting::fit::AdjustTask;
use crate::gpu::device::Gpu;
use crate::gpu::pipeline::KeptPipelines;
use crate::kernels::tuning::Tuning;
use crate::methods;
use crate::model::Model;
use crate::model::scene::Scene;
use crate::plan::Plan;
use crate::render::live::{Live, Refresh, Source};
use crate::render::quantity::Quantity;
use crate::render::renderer::Interlude;
use crate::session::adjusting::{AdjustedViews, CorrectedViews, adjust};
use crate::session::inbox::{Inbox, Taken};
use crate::session::long_work::{LongViewer, LongWork};
use crate::session::progress::{Observer, Progress, State};
use crate::train::trainer::Trainer;
use crate::train::training::Training;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

/// Pause after taking in new frames, as a multiple of the time that took.
const SETTLE: u32 = 4;
/// Shortest time without a new frame that ends the pause early.
const QUIET: Duration = Duration::from_millis(200);
/// Number of intervals between the last frames without a new one after which a run counts as over.
const MISSED_FRAMES: u32 = 3;
/// Interval at which training that waits for frames looks whether it is to pause.
const WAITING: Duration = Duration::from_secs(1);
/// Interval at which training looks again while others wait for the engine.
const GIVE_WAY: Duration = Duration::from_micros(200);

pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// State that the threads of a session share.
pub(super) struct Shared {
    pub(super) gpu: Option<Gpu>,
    pub(super) tuning: Option<Tuning>,
    /// Fits and renderers follow one another, and need the same pipelines.
    pub(super) _pipelines: Option<KeptPipelines>,
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
    pub(super) viewer: Mutex<Option<Viewer>>,
    /// The last live picture.
    pub(super) drawn: Mutex<Option<Drawn>>,
    /// Renderer of long work, for which live pictures do not wait. Work under way keeps the source that it began with.
    pub(super) fields: Mutex<Option<LongViewer>>,
    pub(super) long_work: LongWork,
    /// Whether a thread trains at this moment, which then keeps up to date what live pictures show.
    pub(super) renews: AtomicBool,
    /// Frames that training took in last.
    pub(super) taken: Mutex<Taken>,
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
    /// Version of the inbox whose views were adjusted, or need no adjustment; 0 for none.
    pub(super) adjusted: u64,
    /// Pause before new frames are taken in.
    pub(super) settling: Option<Settling>,
}

/// Pause by which frames that come one after the other are taken in together: otherwise training would do nothing else.
#[derive(Clone, Copy)]
pub(super) struct Settling {
    /// End of the pause.
    until: Instant,
    /// Longest time without a new frame that the pause waits for.
    quiet: Duration,
}

/// Source that is drawn.
#[derive(Default)]
pub(super) struct Published {
    pub(super) generation: u64,
    pub(super) source: Option<Source>,
    /// Number of frames that the field was fitted to.
    pub(super) frames: u32,
}

/// Renderer of live pictures.
#[derive(Clone)]
pub(super) struct Viewer {
    /// Generation of the source that it shows.
    generation: u64,
    /// Number of frames that its field was fitted to.
    frames: u32,
    live: Arc<Live>,
}

/// Field that a live picture showed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Drawn {
    /// Number of frames that it was fitted to; 0 for a checkpoint that was loaded.
    pub frames: u32,
    /// Iterations of the oldest part that the picture shows.
    pub step: u32,
}

/// Training after the adjustment of views.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum AfterAdjusting {
    /// The views stay as they are, so that training has ended.
    Ended,
    /// The views were corrected, and training goes on with them.
    TrainsOn,
}

/// State of training, for those who wait for it.
pub(super) struct Control {
    pub(super) state: State,
    /// Reason why training in the background failed, or why it waits.
    pub(super) reason: Option<String>,
    pub(super) worker: Option<ThreadId>,
    /// When frames or R-peaks came last.
    pub(super) news: Instant,
    /// Time between the last two.
    pub(super) news_apart: Duration,
    /// Version of the inbox at which training in the background found too few frames.
    pub(super) waits_at: u64,
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

    /// Shows another source from now on, whose field was fitted to `frames` frames; none for as many as that shown so far.
    /// Returns the generation of the source.
    pub(super) fn publish(&self, source: Source, frames: Option<u32>) -> u64 {
        let generation = {
            let mut published = lock(&self.published);
            published.generation += 1;
            published.source = Some(source);
            published.frames = frames.unwrap_or(published.frames);
            published.generation
        };
        self.free_fields();
        generation
    }

    /// Prepares to draw the first source before it is published, where pictures are requested already: the first picture then does
    /// not take much longer than others.
    fn first_viewer(&self, source: &Source, step: u32) -> Result<Option<Arc<Live>>> {
        let (gpu, _) = self.device()?;
        if !gpu.looks().are_recent() || lock(&self.published).source.is_some() {
            return Ok(None);
        }
        let live = self.live(source)?;
        live.bake_static_field(step)?;
        Ok(Some(Arc::new(live)))
    }

    /// Frees the memory of the renderer of long work, unless it is in use.
    fn free_fields(&self) {
        if let Ok(mut fields) = self.fields.try_lock() {
            *fields = None;
        }
    }

    fn source(&self) -> (u64, u32, Option<Source>) {
        let published = lock(&self.published);
        (published.generation, published.frames, published.source.clone())
    }

    /// Draws a live picture. It waits for earlier pictures and for submits under way, and for nothing else.
    pub(super) fn with_viewer<T>(
        &self,
        phase: f64,
        quantity: Quantity,
        draw: impl FnOnce(&Live, (u32, Refresh)) -> Result<T>,
    ) -> Result<T> {
        let (gpu, _) = self.device()?;
        let _drawn = gpu.looks().begin();
        let step = self.step.load(Ordering::Acquire);
        let refresh = if self.renews.load(Ordering::Acquire) { Refresh::Beside } else { Refresh::Now };
        let Viewer { live, frames, .. } = self.viewer(refresh)?;
        let picture = draw(&live, (step, refresh))?;
        *lock(&self.drawn) = Some(Drawn { frames, step: live.shown_step(step, phase, quantity) });
        Ok(picture)
    }

    /// Returns what draws live pictures. A new source is prepared here, unless the training thread does so.
    fn viewer(&self, refresh: Refresh) -> Result<Viewer> {
        let mut viewer = lock(&self.viewer);
        let (generation, frames, source) = self.source();
        if let Some(viewer) = &mut *viewer {
            if viewer.generation == generation {
                viewer.frames = frames;
                return Ok(viewer.clone());
            }
            if refresh == Refresh::Beside {
                return Ok(viewer.clone());
            }
        }
        // The memory of the old viewer must be free first.
        *viewer = None;
        let live = Arc::new(self.live(&source.ok_or_else(nothing_yet)?)?);
        Ok(viewer.insert(Viewer { generation, frames, live }).clone())
    }

    fn live(&self, source: &Source) -> Result<Live> {
        let (gpu, tuning) = self.device()?;
        let looks = gpu.looks().clone();
        let interlude: Interlude = Arc::new(move || {
            looks.give_way();
            Ok(())
        });
        Live::new(gpu, source, tuning.clone(), Some(interlude))
    }

    /// Keeps up to date what live pictures show, beside them, in the thread that trains. The earlier source is drawn
    /// until all that pictures needed lately has been prepared from the new one.
    pub(super) fn renew_viewer(&self) {
        let Some(viewer) = lock(&self.viewer).clone() else { return };
        if self.try_renew(&viewer).is_err() {
            // The next picture prepares anew, with the memory of the old viewer, and tells its error.
            *lock(&self.viewer) = None;
        }
    }

    /// Brings what live pictures show up to the present iteration; pictures do so themselves from now on.
    fn stop_renewing(&self) {
        if self.renews.load(Ordering::Acquire) {
            self.renew_viewer();
            let viewer = lock(&self.viewer).clone();
            // The next picture repeats what fails here, and tells its error.
            let _ = viewer.map(|viewer| viewer.live.refresh_all_beside(self.step.load(Ordering::Acquire)));
        }
        self.renews.store(false, Ordering::Release);
    }

    fn try_renew(&self, viewer: &Viewer) -> Result<()> {
        let (gpu, _) = self.device()?;
        let step = self.step.load(Ordering::Acquire);
        let (generation, frames, source) = self.source();
        if viewer.generation == generation {
            return viewer.live.refresh_beside(step);
        }
        let prepared = match source.filter(|_| gpu.looks().are_recent()) {
            Some(source) => {
                let live = Arc::new(self.live(&source)?);
                live.bake_like(&viewer.live, step)?;
                Some(Viewer { generation, frames, live })
            }
            // Nobody looks: the memory is free for training.
            None => None,
        };
        *lock(&self.viewer) = prepared;
        Ok(())
    }

    /// Does long work on the fields as they are at its beginning, in slices that live pictures pass. Long work is done one after
    /// the other.
    pub(super) fn with_fields<T>(&self, work: impl FnOnce(&Live, u32) -> Result<T>) -> Result<T> {
        let (gpu, tuning) = self.device()?;
        let begun = self.long_work.begin();
        let mut fields = lock(&self.fields);
        let step = self.step.load(Ordering::Acquire);
        let (generation, _, source) = self.source();
        let source = source.ok_or_else(nothing_yet)?;
        let viewer = match fields.take() {
            Some(viewer) if viewer.generation == generation => viewer,
            earlier => {
                // The memory of the earlier one must be free first.
                drop(earlier);
                let call = Arc::new(Mutex::new(begun.clone()));
                let live = Live::new(gpu, &source, tuning.clone(), Some(LongWork::interlude(gpu, &call)))?;
                LongViewer { generation, live, call }
            }
        };
        *lock(&viewer.call) = begun;
        work(&fields.insert(viewer).live, step)
    }

    /// Brings the trainer up to the frames there are; `begin` is called when there are enough new ones.
    pub(super) fn take_in_frames(&self, engine: &mut Engine, begin: impl FnOnce()) -> Result<()> {
        let (gpu, tuning) = self.device()?;
        let version = self.version.load(Ordering::Acquire);
        if engine.version == version && engine.training.is_some() {
            return Ok(());
        }
        let started = Instant::now();
        let ((dataset, taken), config, left_out) = {
            let inbox = lock(&self.inbox);
            let left_out = inbox.leaves_out().then(|| inbox.why_left_out());
            (inbox.training_dataset()?, inbox.training_config(), left_out)
        };
        begin();
        if let Some(why) = left_out {
            tracing::info!("some frames are not used: {why}");
        }
        let tuning = beside_pictures(gpu, tuning);
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
        self.free_fields();
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
        // These views are calibrated, and not adjusted yet.
        (engine.version, engine.adjusted) = (version, 0);
        *lock(&self.taken) = taken;
        let took = started.elapsed();
        engine.settling = Some(Settling { until: Instant::now() + took * SETTLE, quiet: took.max(QUIET) });
        self.show(engine, trainer)
    }

    /// Adjusts the views of the frames that training has ended with, `version` of the inbox, once. The reconstruction so far is shown
    /// meanwhile.
    ///
    /// # Errors
    /// [`Error::Interrupted`] where frames have changed meanwhile, or training is to stop or to pause; device errors.
    fn adjust_views(&self, version: u64) -> Result<AfterAdjusting> {
        let (gpu, tuning) = self.device()?;
        if lock(&self.engine).adjusted == version {
            return Ok(AfterAdjusting::Ended);
        }
        let (dataset, mut config) = {
            let inbox = lock(&self.inbox);
            (inbox.training_dataset()?.0, inbox.training_config())
        };
        let tuning = beside_pictures(gpu, tuning);
        config.train.iterations_per_submit = tuning.iterations_per_submit.unwrap_or(config.train.iterations_per_submit);
        let calibration = lock(&self.calibration).clone().unwrap_or_else(|| Calibration::none(None));
        let task = AdjustTask { gpu, config: &config, dataset: &dataset, calibration: &calibration };
        let proceed = || {
            gpu.looks().give_way();
            self.goes_on(version)
        };
        let AdjustedViews { calibration, corrected } = adjust(&task, &proceed)?;
        self.goes_on(version)?;
        let Some(CorrectedViews { dataset, made }) = corrected else {
            lock(&self.engine).adjusted = version;
            *lock(&self.calibration) = Some(calibration);
            return Ok(AfterAdjusting::Ended);
        };
        let plan = match Plan::new(&config, &dataset) {
            Err(why @ (Error::Config { .. } | Error::Unmet { .. } | Error::Data { .. })) => {
                tracing::warn!(
                    "the views stay as they are, because nothing can be fitted to the corrected ones: {why}"
                );
                lock(&self.engine).adjusted = version;
                return Ok(AfterAdjusting::Ended);
            }
            plan => plan?,
        };
        let mut engine = lock(&self.engine);
        self.goes_on(version)?;
        // The reconstruction so far stays until the new one is saved; the memory of its trainer is needed.
        if let Some(training) = &mut engine.training {
            let state = training.trainer_mut().checkpoint()?;
            engine.saved = Some(state);
        }
        engine.training = None;
        self.free_fields();
        let trainer = Trainer::after_adjustment(gpu, plan, &dataset, tuning, made.as_ref())?;
        engine.adjusted = version;
        *lock(&self.calibration) = Some(calibration);
        self.show(&mut engine, trainer)?;
        Ok(AfterAdjusting::TrainsOn)
    }

    /// Returns an error where the frames are no longer those of `version`, or training is to stop or to pause.
    fn goes_on(&self, version: u64) -> Result<()> {
        let ends = self.stop.load(Ordering::Acquire) || self.pause.load(Ordering::Acquire);
        let is_current = self.version.load(Ordering::Acquire) == version;
        if ends || !is_current { Err(Error::Interrupted) } else { Ok(()) }
    }

    /// Trains and shows a trainer from now on.
    fn show(&self, engine: &mut Engine, trainer: Trainer) -> Result<()> {
        self.step.store(trainer.step(), Ordering::Release);
        let shown = (!trainer.shows_earlier()).then_some(engine.frames);
        let source = Source { outline: trainer.outline(), feed: trainer.feed() };
        let first = self.first_viewer(&source, trainer.step())?;
        let generation = self.publish(source, shown);
        if let Some(live) = first {
            *lock(&self.viewer) = Some(Viewer { generation, frames: engine.frames, live });
        }
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
        trainer.take_findings().iter().for_each(|finding| tracing::info!("{finding}"));
        self.step.store(trainer.submitted(), Ordering::Release);
        if !trainer.shows_earlier() {
            lock(&self.published).frames = frames;
        }
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
        let control = lock(&self.control);
        Instant::now() >= until || control.news.elapsed() >= quiet_time(control.news_apart, quiet)
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
        let ended = self.work_until_end(observe);
        self.stop_renewing();
        ended
    }

    fn work_until_end(&self, observe: &mut Observer<'_>) -> Result<State> {
        lock(&self.engine).start_clock();
        loop {
            if self.stop.load(Ordering::Acquire) {
                self.drain(&mut lock(&self.engine))?;
                return Ok(State::Idle);
            }
            if self.pause.load(Ordering::Acquire) {
                self.drain(&mut lock(&self.engine))?;
                self.stop_renewing();
                self.set_state(State::Paused);
                self.rest(Duration::from_secs(1), || self.pause.load(Ordering::Acquire));
                lock(&self.engine).start_clock();
                continue;
            }
            self.renews.store(true, Ordering::Release);
            self.renew_viewer();
            while self.visitors.load(Ordering::Acquire) > 0 {
                std::thread::sleep(GIVE_WAY);
            }
            let mut engine = lock(&self.engine);
            let version = self.version.load(Ordering::Acquire);
            if engine.version != version && self.has_settled(&engine) {
                match self.take_in_frames(&mut engine, || self.set_state(State::Running)) {
                    Ok(()) => (),
                    // The frames are too few, or the settings cannot be met with them: more frames may change that.
                    Err(why @ (Error::NotReady(_) | Error::Unmet { .. } | Error::Data { .. })) => {
                        // Frames may have been removed, or have other geometry: the field so far is kept.
                        self.drain(&mut engine)?;
                        drop(engine);
                        tracing::info!("waiting for frames: {why}");
                        self.wait_for_frames(version, &why);
                        continue;
                    }
                    Err(error) => return Err(error),
                }
            }
            self.set_state(State::Running);
            let (length, taken) = (engine.length(), engine.version);
            let progress = match self.advance(&mut engine, length) {
                Err(why @ Error::Unmet { .. }) => {
                    drop(engine);
                    tracing::info!("waiting for frames: {why}");
                    self.wait_for_frames(taken, &why);
                    continue;
                }
                advanced => advanced?,
            };
            let at_end = engine.step() >= length;
            let done = at_end && engine.version == version;
            drop(engine);
            if progress.is_some_and(|p| !observe(&p)) {
                self.drain(&mut lock(&self.engine))?;
                return Ok(State::Cancelled);
            }
            if done {
                match self.adjust_views(version) {
                    Ok(AfterAdjusting::Ended) => return Ok(State::Finished),
                    Ok(AfterAdjusting::TrainsOn) | Err(Error::Interrupted) => continue,
                    Err(error) => return Err(error),
                }
            }
            if at_end {
                // More frames may follow those that came last.
                self.rest(GIVE_WAY, || true);
            }
        }
    }

    /// Waits until the frames are no longer those of `version`, with which training cannot go on.
    fn wait_for_frames(&self, version: u64, why: &Error) {
        self.stop_renewing();
        {
            let mut control = lock(&self.control);
            (control.state, control.waits_at) = (State::Waiting, version);
            control.reason = Some(why.to_string());
        }
        self.changed.notify_all();
        let unchanged = || self.version.load(Ordering::Acquire) == version;
        let asked = || self.stop.load(Ordering::Acquire) || self.pause.load(Ordering::Acquire);
        while unchanged() && !asked() {
            self.rest(WAITING, unchanged);
        }
        lock(&self.control).reason = None;
    }

    /// Tells whether training in the background has something to do: it trains, plans, or has not yet looked at the newest frames.
    pub(super) fn is_busy(&self) -> bool {
        let control = lock(&self.control);
        has_work(control.state, control.waits_at, self.version.load(Ordering::Acquire))
    }
}

/// Returns the tuning of work beside which pictures are drawn.
fn beside_pictures(gpu: &Gpu, tuning: &Tuning) -> Tuning {
    let mut tuning = tuning.clone();
    if gpu.info().is_cpu() {
        // Views wait for what was submitted before them.
        tuning.iterations_per_submit = Some(1);
    }
    tuning
}

/// Time without a new frame after which no other is expected soon, at most `longest`: a fit that begins without the last frames of a run is
/// lost work.
fn quiet_time(news_apart: Duration, longest: Duration) -> Duration {
    QUIET.max(news_apart.saturating_mul(MISSED_FRAMES)).min(longest)
}

/// Tells whether training in the background has something to do at a version of the frames, when it found too few at `waits_at`.
fn has_work(state: State, waits_at: u64, version: u64) -> bool {
    match state {
        State::Running => true,
        State::Waiting => waits_at != version,
        _ => false,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_is_over_when_some_frames_have_not_come() {
        let ms = Duration::from_millis;
        assert_eq!(quiet_time(ms(66), ms(2000)), QUIET, "fifteen frames per second");
        assert_eq!(quiet_time(ms(500), ms(2000)), ms(1500), "frames that come slowly");
        assert_eq!(quiet_time(ms(60_000), ms(2000)), ms(2000), "the first frame of another run");
    }

    #[test]
    fn frames_that_were_not_looked_at_are_work() {
        assert!(has_work(State::Running, 3, 3), "it plans or trains");
        assert!(has_work(State::Waiting, 3, 4) && !has_work(State::Waiting, 4, 4));
        assert!(!has_work(State::Finished, 3, 4) && !has_work(State::Paused, 3, 4), "nothing happens by itself");
    }
}
