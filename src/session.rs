//! A reconstruction in memory that grows with its frames: angiograms come in at any time, also while training in the
//! background, and any pose and phase can be drawn meanwhile. What the C ABI offers, for Rust.
//!
//! Threads: every function may be called from any thread at any time. Training holds the engine for a few iterations
//! at a time; drawing never waits for more than those.

use crate::config::{Config, DynamicTarget};
use crate::data::dataset::{Dataset, Frame, Layout, Split, View};
use crate::data::gating::RPeaks;
use crate::data::geometry::{Geometry, MM_PER_UNIT, ViewRays};
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::memory::Buffer;
use crate::kernels::Tuning;
use crate::output::eval::{Evaluation, evaluate};
use crate::output::live::{Live, Source};
use crate::output::render::Rendering;
use crate::output::sampled::{Fields, PatientGrid, Quantity};
use crate::train::checkpoint::Checkpoint;
use crate::train::plan::Plan;
use crate::train::trainer::{StepLoss, Trainer};
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{JoinHandle, ThreadId};
use std::time::{Duration, Instant};

/// Name of the thread that trains in the background.
pub const TRAINING_THREAD: &str = "nertca-train";
/// After taking in new frames, this many times as long passes before the next ones are taken in.
const SETTLE: u32 = 4;
/// While others wait for the engine, training looks again after this long.
const GIVE_WAY: Duration = Duration::from_micros(200);

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What a session is about.
#[derive(Debug, Clone)]
pub struct SessionOptions {
    /// Hyper-parameters.
    pub config: Config,
    /// Cardiac phases; 1 for a still object.
    pub phases: u32,
    /// Attenuation is searched within this distance before and behind the isocentre plane, mm.
    pub depth_half_extent_mm: f64,
    /// Attenuation of contrast-filled vessels, 1/mm, where known; a third of it is the Dice threshold.
    pub vessel_attenuation_per_mm: Option<f64>,
    /// Refuse frames while training in the background, so that results never depend on timing.
    pub deterministic: bool,
}

/// When a frame was taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Moment {
    /// At a known cardiac phase, from 0.
    Phase(u32),
    /// At a time in seconds, on the clock of the R-peaks.
    TimeS(f64),
}

/// A calibrated angiogram.
#[derive(Debug, Clone)]
pub struct NewFrame {
    /// How it was taken.
    pub geometry: Geometry,
    /// When.
    pub moment: Moment,
    /// To train on, or to score with.
    pub split: Split,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Line integrals, rows first.
    pub integrals: Vec<f32>,
    /// Vessel mask, where known.
    pub mask: Option<Vec<bool>>,
}

/// What a session is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum State {
    /// Not training.
    Idle,
    /// Training in the background.
    Running,
    /// Held by [`Session::pause`].
    Paused,
    /// Training in the background as soon as there are frames enough.
    Waiting,
    /// All iterations are done.
    Finished,
    /// The observer ended it.
    Cancelled,
    /// An error ended it: see [`Session::failure`].
    Failed,
}

/// How far training is.
#[derive(Debug, Clone, Copy)]
pub struct Progress {
    /// Losses of the last iteration.
    pub loss: StepLoss,
    /// Length of the run.
    pub iterations: u32,
    /// Training frames it uses.
    pub frames: u32,
    /// PSNR of the training rays of the last iteration, dB.
    pub psnr_db: f64,
    /// Iterations per second since training was last begun.
    pub iterations_per_s: f64,
}

/// Told now and then how far training is; returns whether to go on.
pub type Observer<'a> = dyn FnMut(&Progress) -> bool + 'a;

/// See the module.
pub struct Session {
    shared: Arc<Shared>,
    worker: Mutex<Option<JoinHandle<()>>>,
}

struct Shared {
    gpu: Option<Gpu>,
    tuning: Option<Tuning>,
    inbox: Mutex<Inbox>,
    /// Rises with every change of the inbox.
    version: AtomicU64,
    engine: Mutex<Engine>,
    /// Who waits for the engine, other than training in the background.
    visitors: AtomicU32,
    published: Mutex<Published>,
    /// Iterations handed to the device.
    step: AtomicU32,
    viewer: Mutex<Option<(u64, Live)>>,
    control: Mutex<Control>,
    changed: Condvar,
    stop: AtomicBool,
    pause: AtomicBool,
}

struct Inbox {
    options: SessionOptions,
    size: Option<(usize, usize)>,
    views: Vec<View>,
    frames: Vec<(Frame, Moment)>,
    r_peaks: Option<RPeaks>,
}

#[derive(Default)]
struct Engine {
    trainer: Option<Trainer>,
    /// State to begin from where there is no trainer, and to fall back to.
    saved: Option<Checkpoint>,
    /// Of the inbox the trainer was built from.
    version: u64,
    frames: u32,
    /// Span of their line integrals.
    image_range: f64,
    /// New frames are left waiting until then.
    settled: Option<Instant>,
}

/// What is drawn.
#[derive(Default)]
struct Published {
    generation: u64,
    source: Option<Source>,
}

struct Control {
    state: State,
    failure: Option<String>,
    worker: Option<ThreadId>,
}

impl Session {
    /// Begins without frames. Without a device, frames are checked and kept, but nothing can be trained or drawn.
    ///
    /// # Errors
    /// [`Error::Config`] naming the option that no session could use.
    pub fn new(gpu: Option<Gpu>, tuning: Option<Tuning>, options: SessionOptions) -> Result<Session> {
        options.config.check()?;
        if options.phases == 0 || options.phases > 4096 {
            return Err(Error::config("phases", options.phases, "1 to 4096 are accepted"));
        }
        let positive = |field: &str, value: f64| {
            let ok = value.is_finite() && value > 0.0 && value < 1e5;
            if ok { Ok(()) } else { Err(Error::config(field, value, "is not a positive number")) }
        };
        positive("depth_half_extent_mm", options.depth_half_extent_mm)?;
        if let Some(attenuation) = options.vessel_attenuation_per_mm {
            positive("vessel_attenuation_per_mm", attenuation)?;
        }
        let inbox = Inbox { options, size: None, views: Vec::new(), frames: Vec::new(), r_peaks: None };
        Ok(Session {
            shared: Arc::new(Shared {
                gpu,
                tuning,
                inbox: Mutex::new(inbox),
                version: AtomicU64::new(1),
                engine: Mutex::default(),
                visitors: AtomicU32::new(0),
                published: Mutex::default(),
                step: AtomicU32::new(0),
                viewer: Mutex::new(None),
                control: Mutex::new(Control { state: State::Idle, failure: None, worker: None }),
                changed: Condvar::new(),
                stop: AtomicBool::new(false),
                pause: AtomicBool::new(false),
            }),
            worker: Mutex::new(None),
        })
    }

    /// Adds a frame. Training in the background takes it in by itself, soon; training that starts later, at once.
    ///
    /// # Errors
    /// [`Error::Config`] naming what is wrong with it; [`Error::Busy`] while a deterministic session is training.
    pub fn add_frame(&self, new: NewFrame) -> Result<()> {
        let shared = &self.shared;
        let mut inbox = lock(&shared.inbox);
        if inbox.options.deterministic && matches!(self.state(), State::Running | State::Waiting) {
            return Err(Error::Busy("a deterministic session takes no frames while it trains".into()));
        }
        inbox.add(new)?;
        drop(inbox);
        self.announce();
        Ok(())
    }

    /// Gives the R-peaks by which frames with time stamps get their phase; replaces earlier ones.
    pub fn set_r_peaks(&self, r_peaks: RPeaks) {
        lock(&self.shared.inbox).r_peaks = Some(r_peaks);
        self.announce();
    }

    fn announce(&self) {
        self.shared.version.fetch_add(1, Ordering::AcqRel);
        // The lock keeps the news from falling between a worker's look and its wait.
        drop(lock(&self.shared.control));
        self.shared.changed.notify_all();
    }

    /// Frames added so far.
    pub fn n_frames(&self) -> usize {
        lock(&self.shared.inbox).frames.len()
    }

    /// Cardiac phases.
    pub fn phases(&self) -> u32 {
        lock(&self.shared.inbox).options.phases
    }

    /// Iterations handed to the device.
    pub fn step(&self) -> u32 {
        self.shared.step.load(Ordering::Acquire)
    }

    /// What training is doing.
    pub fn state(&self) -> State {
        lock(&self.shared.control).state
    }

    /// What ended training in the background, if an error did.
    pub fn failure(&self) -> Option<String> {
        lock(&self.shared.control).failure.clone()
    }

    /// Trains up to `iterations` more, with the frames there are, and returns how many were done: fewer at the end of
    /// the run, or when the observer ends it.
    ///
    /// # Errors
    /// [`Error::Busy`] while training in the background, [`Error::NotReady`] without frames enough, [`Error::NoDevice`];
    /// [`Error::Diverged`]: the last good state stays; device errors.
    pub fn train(&self, iterations: u32, observe: &mut Observer<'_>) -> Result<u32> {
        if lock(&self.worker).as_ref().is_some_and(|w| !w.is_finished()) {
            return Err(Error::Busy("the session is training in the background".into()));
        }
        let shared = &self.shared;
        let first = {
            let mut engine = shared.visit();
            shared.take_in_frames(&mut engine)?;
            engine.trainer.as_ref().map_or(0, Trainer::step)
        };
        let begin = Instant::now();
        loop {
            let (progress, done) = {
                let mut engine = shared.visit();
                let length = engine.length();
                let end = length.min(first.saturating_add(iterations));
                let progress = shared.advance(&mut engine, end, first, begin)?;
                (progress, engine.trainer.as_ref().is_none_or(|t| t.step() >= end))
            };
            let go_on = progress.is_none_or(|p| observe(&p));
            if done || !go_on {
                let mut engine = shared.visit();
                shared.drain(&mut engine)?;
                return Ok(engine.trainer.as_ref().map_or(0, Trainer::step) - first);
            }
        }
    }

    /// Trains in the background until the run is done, paused or stopped; waits for frames while there are too few.
    ///
    /// # Errors
    /// [`Error::Busy`] when it trains already; [`Error::NoDevice`].
    pub fn start(&self, mut observe: Box<dyn FnMut(&Progress) -> bool + Send>) -> Result<()> {
        let mut worker = lock(&self.worker);
        if worker.as_ref().is_some_and(|w| !w.is_finished()) {
            return Err(Error::Busy("the session is training in the background already".into()));
        }
        self.shared.device()?;
        let shared = self.shared.clone();
        shared.stop.store(false, Ordering::Release);
        shared.pause.store(false, Ordering::Release);
        {
            let mut control = lock(&shared.control);
            (control.state, control.failure) = (State::Running, None);
        }
        let dispatch = tracing::dispatcher::get_default(Clone::clone);
        let spawned = std::thread::Builder::new().name(TRAINING_THREAD.into()).spawn(move || {
            tracing::dispatcher::with_default(&dispatch, || {
                lock(&shared.control).worker = Some(std::thread::current().id());
                let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| shared.work(&mut *observe)))
                    .unwrap_or_else(|_| Err(Error::Internal("training panicked".into())));
                let mut control = lock(&shared.control);
                control.worker = None;
                match outcome {
                    Ok(state) => control.state = state,
                    Err(error) => {
                        tracing::error!("training in the background: {error}");
                        (control.state, control.failure) = (State::Failed, Some(error.to_string()));
                    }
                }
                drop(control);
                shared.changed.notify_all();
            });
        });
        match spawned {
            Ok(handle) => *worker = Some(handle),
            Err(e) => {
                lock(&self.shared.control).state = State::Idle;
                return Err(Error::Internal(format!("starting a thread: {e}")));
            }
        }
        Ok(())
    }

    /// Holds training in the background after the iterations under way.
    pub fn pause(&self) {
        self.shared.pause.store(true, Ordering::Release);
    }

    /// Lets paused training go on.
    pub fn resume(&self) {
        self.shared.pause.store(false, Ordering::Release);
        drop(lock(&self.shared.control));
        self.shared.changed.notify_all();
    }

    /// Ends training in the background after the iterations under way, and waits for that. State is kept: training
    /// may be started again.
    ///
    /// # Errors
    /// [`Error::Busy`] from the observer itself, which ends training by its result instead.
    pub fn stop(&self) -> Result<()> {
        if lock(&self.shared.control).worker == Some(std::thread::current().id()) {
            return Err(Error::Busy("an observer ends training by what it returns".into()));
        }
        self.shared.stop.store(true, Ordering::Release);
        drop(lock(&self.shared.control));
        self.shared.changed.notify_all();
        if let Some(handle) = lock(&self.worker).take() {
            // A panic of the worker has become its failure.
            let _ = handle.join();
        }
        Ok(())
    }

    /// Waits until training in the background has ended, at most so long; whether it has.
    pub fn wait(&self, limit: Duration) -> bool {
        let until = Instant::now() + limit;
        let mut control = lock(&self.shared.control);
        loop {
            if !matches!(control.state, State::Running | State::Waiting | State::Paused) {
                return true;
            }
            let Some(left) = until.checked_duration_since(Instant::now()).filter(|d| !d.is_zero()) else {
                return false;
            };
            control = self.shared.changed.wait_timeout(control, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Draws a view through baked volumes, at display rates, also while training; see [`Live::render`].
    ///
    /// # Errors
    /// [`Error::NotReady`] before anything was trained or loaded; as [`Live::render`].
    pub fn render(&self, rays: &ViewRays, size: (usize, usize), phase: u32, quantity: Quantity) -> Result<Vec<f32>> {
        self.shared.with_viewer(|live, step| live.render(step, rays, size, phase, quantity))
    }

    /// As [`Session::render`], into a buffer on the device: `size.0` x `size.1` floats.
    ///
    /// # Errors
    /// As [`Session::render`]; [`Error::Internal`] when the buffer is too small.
    pub fn render_into(
        &self,
        target: &Buffer,
        rays: &ViewRays,
        size: (usize, usize),
        phase: u32,
        quantity: Quantity,
    ) -> Result<()> {
        self.shared.with_viewer(|live, step| live.render_into(target, step, rays, size, phase, quantity))
    }

    /// Draws a view through the fields themselves: slower, and exact.
    ///
    /// # Errors
    /// As [`Session::render`].
    pub fn render_fields(&self, rays: &ViewRays, size: (usize, usize), phase: u32) -> Result<Rendering> {
        self.shared.with_viewer(|live, step| live.render_fields(step, rays, size, phase))
    }

    /// Attenuation per mm at the points of a grid.
    ///
    /// # Errors
    /// As [`Session::render`] and [`crate::output::render::Renderer::sample_patient`].
    pub fn sample(&self, fields: Fields, grid: &PatientGrid) -> Result<Vec<f32>> {
        self.shared.with_viewer(|live, step| live.renderer(step)?.sample_patient(fields, grid))
    }

    /// Scores the frames that were added for validation. `threshold_per_mm` replaces the rule for the Dice threshold.
    ///
    /// # Errors
    /// [`Error::Data`] without such frames; as [`Session::render`].
    pub fn evaluate(&self, threshold_per_mm: Option<f64>) -> Result<Evaluation> {
        let dataset = lock(&self.shared.inbox).dataset(|_, _| true)?;
        let frames: Vec<_> = dataset.validation().iter().collect();
        let threshold = threshold_per_mm.map(|t| t * MM_PER_UNIT);
        self.shared.with_viewer(|live, step| {
            evaluate(live.renderer(step)?, &dataset, &frames, step, threshold, |_, _, _| Ok(()))
        })
    }

    /// Everything needed to continue, after the iterations under way.
    ///
    /// # Errors
    /// [`Error::NotReady`] before anything was trained or loaded; device errors.
    pub fn checkpoint(&self) -> Result<Checkpoint> {
        let mut engine = self.shared.visit();
        let engine = &mut *engine;
        match (&mut engine.trainer, &engine.saved) {
            (Some(trainer), _) => trainer.checkpoint(),
            (None, Some(saved)) => Ok(saved.clone()),
            (None, None) => Err(nothing_yet()),
        }
    }

    /// Takes over a checkpoint with its hyper-parameters; training continues from it with the frames of this session.
    ///
    /// # Errors
    /// [`Error::Busy`] while training in the background; [`Error::Config`] when frames of more phases were added already.
    pub fn load(&self, checkpoint: Checkpoint) -> Result<()> {
        if lock(&self.worker).as_ref().is_some_and(|w| !w.is_finished()) {
            return Err(Error::Busy("the session is training in the background: stop it first".into()));
        }
        let model = &checkpoint.model;
        let mut engine = self.shared.visit();
        let mut inbox = lock(&self.shared.inbox);
        let phases = model.layout.phases as u32;
        if inbox.options.phases != phases && !inbox.frames.is_empty() {
            let problem = format!("the session's frames are of {} phases", inbox.options.phases);
            return Err(Error::config("checkpoint: phases", phases, problem));
        }
        inbox.options.phases = phases;
        inbox.options.config = model.config.clone();
        engine.trainer = None;
        engine.version = 0;
        self.shared.publish(Source { outline: model.clone(), params: None });
        self.shared.step.store(model.step, Ordering::Release);
        lock(&self.shared.control).state = State::Idle;
        engine.saved = Some(checkpoint);
        Ok(())
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        // Only an observer that owns the session could fail here, and then the thread is its own.
        let _ = self.stop();
    }
}

fn nothing_yet() -> Error {
    Error::NotReady("there is no reconstruction yet: train, or load a checkpoint".into())
}

impl Inbox {
    fn add(&mut self, new: NewFrame) -> Result<()> {
        let bad =
            |field: &str, value: String, problem: String| Error::config(format!("frame: {field}"), value, problem);
        let pixels = new.width.checked_mul(new.height).filter(|n| *n > 0);
        if pixels != Some(new.integrals.len()) || new.mask.as_ref().is_some_and(|m| Some(m.len()) != pixels) {
            let size = format!("{} x {}", new.width, new.height);
            return Err(bad("size", size, "does not fit its pixels or mask".into()));
        }
        if let Some(size) = self.size.filter(|size| *size != (new.width, new.height)) {
            let problem = format!("earlier frames have {} x {}; all must be of one size", size.0, size.1);
            return Err(bad("size", format!("{} x {}", new.width, new.height), problem));
        }
        if let Some(at) = new.integrals.iter().position(|v| !v.is_finite()) {
            let pixel = format!("column {}, row {}", at % new.width, at / new.width);
            return Err(bad("pixels", pixel, format!("{} is no line integral", new.integrals[at])));
        }
        match new.moment {
            Moment::Phase(phase) if phase >= self.options.phases => {
                let problem = format!("phases go from 0 to {}", self.options.phases - 1);
                return Err(bad("phase", phase.to_string(), problem));
            }
            Moment::TimeS(time) if !time.is_finite() => {
                return Err(bad("time", time.to_string(), "is not a time in seconds".into()));
            }
            _ => (),
        }
        let rays =
            new.geometry.rays(new.width, new.height).map_err(|(field, problem)| bad(&field, String::new(), problem))?;
        let depth = self.options.depth_half_extent_mm / MM_PER_UNIT;
        if rays.sod <= depth {
            let problem = format!("the source stands inside the depth range of {} mm", depth * MM_PER_UNIT);
            return Err(bad("sod_mm", format!("{:.0}", rays.sod * MM_PER_UNIT), problem));
        }
        self.size = Some((new.width, new.height));
        let view = match self.views.iter().position(|v| v.geometry == new.geometry) {
            Some(view) => view,
            None => {
                self.views.push(View { geometry: new.geometry, rays });
                self.views.len() - 1
            }
        };
        let frame = Frame {
            name: format!("frame-{}", self.frames.len()),
            view,
            phase: if let Moment::Phase(phase) = new.moment { phase } else { 0 },
            split: new.split,
            integrals: new.integrals,
            mask: new.mask,
        };
        self.frames.push((frame, new.moment));
        Ok(())
    }

    /// The frames whose phase is known and that `keep` wants.
    fn dataset(&self, keep: impl Fn(&Frame, &[Frame]) -> bool) -> Result<Dataset> {
        let phase = |moment: Moment| match (moment, &self.r_peaks) {
            (Moment::Phase(phase), _) => Some(phase),
            (Moment::TimeS(time), Some(peaks)) => peaks.phase(time, self.options.phases),
            (Moment::TimeS(_), None) => None,
        };
        let known: Vec<Frame> = self
            .frames
            .iter()
            .filter_map(|(frame, moment)| phase(*moment).map(|phase| Frame { phase, ..frame.clone() }))
            .collect();
        let mut frames: Vec<Frame> = known.iter().filter(|f| keep(f, &known)).cloned().collect();
        frames.sort_by_key(|f| f.split);
        let Some((width, height)) = self.size.filter(|_| !frames.is_empty()) else {
            let n = self.frames.len();
            return Err(Error::NotReady(format!(
                "none of {n} frames can be used: a phase, or a time stamp and R-peaks, is needed, and two phases of a view"
            )));
        };
        let half = self.options.depth_half_extent_mm / MM_PER_UNIT;
        Ok(Dataset {
            path: PathBuf::from("session"),
            layout: Layout::Native,
            views: self.views.clone(),
            frames,
            width,
            height,
            n_phases: self.options.phases,
            depth_range: (-half, half),
            vessel_attenuation: self.options.vessel_attenuation_per_mm.map(|a| a * MM_PER_UNIT),
        })
    }

    /// The training frames: with a temporal target, those of views seen at two phases or more.
    fn training_dataset(&self) -> Result<Dataset> {
        let temporal = self.options.config.loss.dynamic_target == DynamicTarget::Temporal;
        let dataset = self.dataset(|frame, known| {
            let beats = |f: &&Frame| f.view == frame.view && f.split == Split::Train && f.phase != frame.phase;
            frame.split == Split::Train && (!temporal || known.iter().any(|f| beats(&f)))
        })?;
        let views = dataset.training_views().len();
        if temporal && views < 2 {
            return Err(Error::NotReady(format!("{views} views at two phases or more, where at least two are needed")));
        }
        Ok(dataset)
    }
}

impl Engine {
    fn length(&self) -> u32 {
        self.trainer.as_ref().map_or(0, |t| t.plan().config.train.iterations)
    }
}

impl Shared {
    fn device(&self) -> Result<(&Gpu, &Tuning)> {
        match (&self.gpu, &self.tuning) {
            (Some(gpu), Some(tuning)) => Ok((gpu, tuning)),
            _ => Err(Error::NoDevice("the context was made without a device".into())),
        }
    }

    /// The engine, before training in the background takes it again.
    fn visit(&self) -> MutexGuard<'_, Engine> {
        self.visitors.fetch_add(1, Ordering::AcqRel);
        let engine = lock(&self.engine);
        self.visitors.fetch_sub(1, Ordering::AcqRel);
        engine
    }

    fn publish(&self, source: Source) {
        let mut published = lock(&self.published);
        published.generation += 1;
        published.source = Some(source);
    }

    fn with_viewer<T>(&self, draw: impl FnOnce(&mut Live, u32) -> Result<T>) -> Result<T> {
        let (gpu, tuning) = self.device()?;
        let mut viewer = lock(&self.viewer);
        let step = self.step.load(Ordering::Acquire);
        let (generation, source) = {
            let published = lock(&self.published);
            let current = viewer.as_ref().is_some_and(|(of, _)| *of == published.generation);
            (published.generation, if current { None } else { published.source.clone() })
        };
        if let Some(source) = source {
            // The old one's memory is needed first.
            *viewer = None;
            *viewer = Some((generation, Live::new(gpu, &source, tuning.clone())?));
        }
        match &mut *viewer {
            Some((_, live)) => draw(live, step),
            None => Err(nothing_yet()),
        }
    }

    /// Brings the trainer up to the frames there are.
    fn take_in_frames(&self, engine: &mut Engine) -> Result<()> {
        let (gpu, tuning) = self.device()?;
        let version = self.version.load(Ordering::Acquire);
        if engine.version == version && engine.trainer.is_some() {
            return Ok(());
        }
        let begin = Instant::now();
        let (dataset, mut config) = {
            let inbox = lock(&self.inbox);
            (inbox.training_dataset()?, inbox.options.config.clone())
        };
        if gpu.info().kind == "cpu" {
            // Views wait for what was submitted before them.
            config.train.iterations_per_submit = 1;
        }
        let fresh = Plan::new(&config, &dataset)?;
        if let Some(trainer) = &mut engine.trainer {
            let state = trainer.checkpoint()?;
            let fits = holds(&state.model.scene, &fresh.scene);
            if !fits {
                tracing::warn!("new frames show vessels outside the box trained so far: training starts over");
            }
            engine.saved = fits.then_some(state);
        }
        (engine.trainer, engine.version) = (None, 0); // its memory is needed
        let trainer = match &engine.saved {
            None => Trainer::new(gpu, fresh, &dataset, tuning.clone())?,
            Some(state) => {
                let plan = Plan::with_scene(&config, &dataset, state.model.scene.clone())?;
                Trainer::carry_on(gpu, plan, &dataset, tuning.clone(), state)?
            }
        };
        tracing::info!("training on {} frames from iteration {}", dataset.training().len(), trainer.step());
        trainer.plan().notes.iter().for_each(|note| tracing::info!("{note}"));
        engine.frames = dataset.training().len() as u32;
        engine.version = version;
        engine.settled = Some(Instant::now() + begin.elapsed() * SETTLE);
        self.step.store(trainer.step(), Ordering::Release);
        let params = Some(trainer.buffers().get("params")?.clone());
        self.publish(Source { outline: trainer.outline(), params });
        engine.image_range = image_range(&trainer.plan().images);
        engine.trainer = Some(trainer);
        Ok(())
    }

    /// Keeps the device busy towards `end`.
    fn advance(&self, engine: &mut Engine, end: u32, first: u32, begin: Instant) -> Result<Option<Progress>> {
        let (frames, range) = (engine.frames, engine.image_range);
        let Some(trainer) = &mut engine.trainer else { return Ok(None) };
        let before = trainer.step();
        let losses = match trainer.advance(end) {
            Ok(losses) => losses,
            Err(error) => {
                self.fall_back(engine);
                return Err(error);
            }
        };
        self.step.store(trainer.submitted(), Ordering::Release);
        let config = &trainer.plan().config;
        let every = config.train.checkpoint_every;
        let progress = losses.last().map(|loss| Progress {
            loss: *loss,
            iterations: config.train.iterations,
            frames,
            psnr_db: -10.0 * (loss.squared_error / (range * range)).max(1e-20).log10(),
            iterations_per_s: f64::from(loss.step - first) / begin.elapsed().as_secs_f64().max(1e-9),
        });
        if before / every != trainer.step() / every {
            engine.saved = Some(trainer.checkpoint()?);
        }
        Ok(progress)
    }

    /// Lets the iterations under way finish.
    fn drain(&self, engine: &mut Engine) -> Result<()> {
        let Some(trainer) = &mut engine.trainer else { return Ok(()) };
        while trainer.step() < trainer.submitted() {
            trainer.advance(trainer.submitted())?;
        }
        Ok(())
    }

    /// After a failure, shows the last good state, if there is one.
    fn fall_back(&self, engine: &mut Engine) {
        engine.trainer = None;
        engine.version = 0;
        let source = engine.saved.as_ref().map(|saved| Source { outline: saved.model.clone(), params: None });
        self.step.store(engine.saved.as_ref().map_or(0, |s| s.model.step), Ordering::Release);
        let mut published = lock(&self.published);
        published.generation += 1;
        published.source = source;
        drop(published);
        *lock(&self.viewer) = None;
    }

    fn set_state(&self, state: State) {
        lock(&self.control).state = state;
        self.changed.notify_all();
    }

    /// Waits for a change, at most until `limit`.
    fn rest(&self, limit: Duration, reason: impl Fn() -> bool) {
        let control = lock(&self.control);
        if reason() && !self.stop.load(Ordering::Acquire) {
            drop(self.changed.wait_timeout(control, limit).unwrap_or_else(PoisonError::into_inner));
        }
    }

    /// Training in the background.
    fn work(&self, observe: &mut Observer<'_>) -> Result<State> {
        let mut begin = Instant::now();
        let mut first = None;
        loop {
            if self.stop.load(Ordering::Acquire) {
                self.drain(&mut lock(&self.engine))?;
                return Ok(State::Idle);
            }
            if self.pause.load(Ordering::Acquire) {
                self.drain(&mut lock(&self.engine))?;
                self.set_state(State::Paused);
                self.rest(Duration::from_secs(1), || self.pause.load(Ordering::Acquire));
                (begin, first) = (Instant::now(), None);
                continue;
            }
            while self.visitors.load(Ordering::Acquire) > 0 {
                std::thread::sleep(GIVE_WAY);
            }
            let mut engine = lock(&self.engine);
            let version = self.version.load(Ordering::Acquire);
            if engine.version != version && engine.settled.is_none_or(|until| Instant::now() >= until) {
                match self.take_in_frames(&mut engine) {
                    Ok(()) => (begin, first) = (Instant::now(), None),
                    Err(Error::NotReady(why)) if engine.trainer.is_none() => {
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
            let step = engine.trainer.as_ref().map_or(0, Trainer::step);
            let first = *first.get_or_insert(step);
            let length = engine.length();
            let progress = self.advance(&mut engine, length, first, begin)?;
            let done = engine.trainer.as_ref().is_none_or(|t| t.step() >= length) && engine.version == version;
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

/// Whether fields trained in an old scene can go on in a new one: their box holds it, and numbers are of a like size.
fn holds(old: &crate::model::scene::Scene, new: &crate::model::scene::Scene) -> bool {
    let slack = 0.02 * (0..3).map(|i| old.dynamic_max[i] - old.dynamic_min[i]).fold(0.0, f64::max);
    let inside = (0..3)
        .all(|i| new.dynamic_min[i] >= old.dynamic_min[i] - slack && new.dynamic_max[i] <= old.dynamic_max[i] + slack);
    let alike = |a: f64, b: f64| a / b < 2.0 && b / a < 2.0;
    inside && alike(old.static_gain, new.static_gain) && alike(old.dynamic_gain, new.dynamic_gain)
}

fn image_range(images: &[f32]) -> f64 {
    let (low, high) = images.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    f64::from(high - low)
}
