//! A reconstruction in memory that grows with its frames: angiograms come in at any time, also while training in the
//! background, and any pose and phase can be drawn meanwhile. This is the Rust side of the C ABI.
//!
//! Threads: every function may be called from any thread at any time. Training holds the engine for a few iterations
//! at a time; drawing never waits for more than those.

mod corrected;
mod inbox;
mod known;
mod long_work;
mod progress;
mod refining;
mod showing;
mod state;
mod training;
mod truth;

use crate::calibrate::correction::Calibration;
use crate::checkpoint::Checkpoint;
use crate::error::{Error, Result};
use crate::geometry::{Geometry, ViewRays};
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::model::component::Component;
use crate::render::grid::PatientGrid;
use crate::render::live::Source;
use crate::render::quantity::Quantity;
use crate::render::renderer::{Renderer, Rendering};
use crate::scan::at_rest;
use crate::scan::gating::{BeatTime, RPeaks};
use crate::scan::prior::VesselPrior;
use crate::trees::doubt::compare_with_views;
use crate::trees::extract::{TreeOptions, vessel_trees};
use crate::trees::tree::BeatTree;
pub use corrected::CorrectedFrame;
pub use inbox::{FrameStatus, FrameTime, FrameUse, NewFrame, SessionOptions};
use inbox::{Inbox, Kept};
use known::TrueShapes;
use long_work::{LongCall, LongWork};
pub use progress::{Observer, Progress, State};
pub use state::Drawn;
use state::{Control, Shared, lock, nothing_yet};
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError, TryLockError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Name of the thread that trains in the background.
pub const TRAINING_THREAD: &str = "nertca-train";

/// A reconstruction in memory that grows with its frames (see the module).
pub struct Session {
    shared: Arc<Shared>,
    worker: Mutex<Option<JoinHandle<()>>>,
    /// Held by training in a caller's thread.
    blocking: Mutex<()>,
    known: Mutex<TrueShapes>,
}

impl Session {
    /// Begins without frames. Without a device, frames are checked and kept, but nothing can be trained or drawn.
    ///
    /// # Errors
    /// [`Error::Config`] naming the option that no session could use.
    pub fn new(gpu: Option<Gpu>, tuning: Option<Tuning>, mut options: SessionOptions) -> Result<Session> {
        options.config.check()?;
        if options.still {
            options.phases = phases_at_rest(options.phases)?;
        }
        if options.phases == 0 || options.phases > 4096 {
            return Err(Error::config("phases", options.phases, "is out of range: 1 to 4096 phases are accepted"));
        }
        let positive = |field: &str, value: f64| {
            let ok = value.is_finite() && value > 0.0 && value < 1e5;
            if ok { Ok(()) } else { Err(Error::config(field, value, "is not a positive number")) }
        };
        positive("depth_half_extent_mm", options.depth_half_extent_mm)?;
        if let Some(attenuation) = options.vessel_attenuation_per_mm {
            positive("vessel_attenuation_per_mm", attenuation)?;
        }
        let inbox = Inbox { options, views: Vec::new(), frames: Vec::new(), prior: None, r_peaks: None };
        Ok(Session {
            shared: Arc::new(Shared {
                _pipelines: gpu.as_ref().map(Gpu::keep_pipelines),
                gpu,
                tuning,
                inbox: Mutex::new(inbox),
                version: AtomicU64::new(1),
                engine: Mutex::default(),
                visitors: AtomicU32::new(0),
                published: Mutex::default(),
                calibration: Mutex::default(),
                step: AtomicU32::new(0),
                viewer: Mutex::default(),
                drawn: Mutex::default(),
                fields: Mutex::default(),
                long_work: LongWork::default(),
                renews: AtomicBool::new(false),
                taken: Mutex::default(),
                control: Mutex::new(Control {
                    state: State::Idle,
                    reason: None,
                    worker: None,
                    news: Instant::now(),
                    news_apart: Duration::MAX,
                    waits_at: 0,
                }),
                changed: Condvar::new(),
                stop: AtomicBool::new(false),
                pause: AtomicBool::new(false),
            }),
            worker: Mutex::new(None),
            blocking: Mutex::default(),
            known: Mutex::default(),
        })
    }

    /// Adds a frame; frames are counted from 0. Training in the background takes it in soon, by itself; training that starts
    /// later takes it in at once.
    ///
    /// # Errors
    /// [`Error::Config`] naming what is wrong with it; [`Error::Busy`] while a deterministic session is training.
    pub fn add_frame(&self, new: NewFrame) -> Result<()> {
        self.change_frames(|inbox| inbox.add(new))
    }

    /// States another geometry for a frame that was added, for example when the C-arm or an external calibration knows it
    /// better. Training takes it in as it does a new frame; training that has ended takes it in when it is started again. Returns
    /// the use of the frame, which may be the only one of its view from now on.
    ///
    /// # Errors
    /// As [`Session::add_frame`]; [`Error::Config`] for a frame that was not added.
    pub fn set_geometry(&self, frame: usize, geometry: Geometry) -> Result<FrameUse> {
        let usage = self.change_frames(|inbox| inbox.set_geometry(frame, geometry, false))?;
        if usage == FrameUse::OnePhase {
            tracing::warn!(
                "frame {frame}: no training frame of another phase shares its new geometry within a tenth of a pixel, so \
                 training does not use it until one does"
            );
        }
        Ok(usage)
    }

    /// States another geometry for a frame and for all others of its view, as [`Session::set_geometry`] does.
    ///
    /// # Errors
    /// As [`Session::set_geometry`].
    pub fn set_view_geometry(&self, frame: usize, geometry: Geometry) -> Result<FrameUse> {
        self.change_frames(|inbox| inbox.set_geometry(frame, geometry, true))
    }

    /// Removes a frame; the others keep their numbers. Training takes that in as it does a new frame.
    ///
    /// # Errors
    /// As [`Session::set_geometry`].
    pub fn remove_frame(&self, frame: usize) -> Result<()> {
        self.change_frames(|inbox| inbox.remove(frame))
    }

    /// Returns phase, view and use of a frame.
    ///
    /// # Errors
    /// [`Error::Config`] for a frame that was not added, or was removed.
    pub fn frame_status(&self, frame: usize) -> Result<FrameStatus> {
        let taken = lock(&self.shared.taken).clone();
        lock(&self.shared.inbox).status(frame, &taken)
    }

    /// Returns the time in the beat of a time in seconds by the R-peaks; none where these do not cover it.
    pub fn beat_time(&self, time_s: f64) -> Option<BeatTime> {
        lock(&self.shared.inbox).beat_time(FrameTime::TimeS(time_s))
    }

    fn change_frames<T>(&self, change: impl FnOnce(&mut Inbox) -> Result<T>) -> Result<T> {
        let mut inbox = lock(&self.shared.inbox);
        if inbox.options.deterministic && matches!(self.state(), State::Running | State::Waiting) {
            return Err(Error::Busy("a deterministic session accepts no frames while it trains".into()));
        }
        let changed = change(&mut inbox)?;
        drop(inbox);
        self.announce();
        Ok(changed)
    }

    /// How the reconstruction sees a frame, counted from 0 as they were added: as stated, or as calibration corrected it
    /// when training last took frames in. A checkpoint that was loaded says nothing of it.
    ///
    /// # Errors
    /// [`Error::Config`] for a frame that was not added.
    pub fn corrected_frame(&self, frame: usize) -> Result<CorrectedFrame> {
        let calibration = lock(&self.shared.calibration).clone().unwrap_or_else(|| Calibration::none(None));
        let inbox = lock(&self.shared.inbox);
        let Kept { frame, moment, .. } = inbox.frame(frame)?;
        CorrectedFrame::new(
            &inbox.views[frame.view],
            frame,
            inbox.beat_time(*moment).map(|taken| taken.phase),
            &calibration,
        )
    }

    /// Returns the corrections of the views that training uses; none before it begins, and for a checkpoint that was loaded.
    pub fn calibration(&self) -> Option<Calibration> {
        lock(&self.shared.calibration).clone()
    }

    /// Gives the R-peaks by which frames with time stamps get their phase; replaces earlier ones. None clears them.
    ///
    /// # Errors
    /// [`Error::Busy`] while a deterministic session is training.
    pub fn set_r_peaks(&self, r_peaks: Option<RPeaks>) -> Result<()> {
        self.change_frames(|inbox| {
            inbox.r_peaks = r_peaks;
            Ok(())
        })
    }

    /// States vessels that are known before, for example from a CT; replaces earlier ones. None clears them. Fits that begin later seed
    /// their Gaussians by them; those under way go on.
    ///
    /// # Errors
    /// [`Error::Config`] for a method without a prior, for a prior without points, and for coordinates that are not finite;
    /// [`Error::Busy`] while a deterministic session is training.
    pub fn set_prior(&self, prior: Option<VesselPrior>) -> Result<()> {
        if let Some(prior) = &prior {
            prior.check()?;
        }
        self.change_frames(|inbox| {
            if prior.is_some() {
                inbox.options.config.takes_prior("prior", "vessels")?;
            }
            inbox.prior = prior.map(Arc::new);
            Ok(())
        })
    }

    fn announce(&self) {
        self.shared.version.fetch_add(1, Ordering::AcqRel);
        // The lock keeps the news from falling between a worker's look and its wait.
        let (now, mut control) = (Instant::now(), lock(&self.shared.control));
        (control.news_apart, control.news) = (now.saturating_duration_since(control.news), now);
        drop(control);
        self.shared.changed.notify_all();
    }

    /// Frames added so far, removed ones included.
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

    /// State of training.
    pub fn state(&self) -> State {
        lock(&self.shared.control).state
    }

    /// Tells whether training in the background has something to do: it trains, prepares to, or has not yet looked at the newest
    /// frames. Waiting for frames is not being busy.
    pub fn is_busy(&self) -> bool {
        self.shared.is_busy()
    }

    /// Returns the error that ended training in the background, if one did.
    pub fn failure(&self) -> Option<String> {
        self.reason(State::Failed)
    }

    /// Returns the reason why training in the background waits for other frames, while it does.
    pub fn waits_for(&self) -> Option<String> {
        self.reason(State::Waiting)
    }

    fn reason(&self, of: State) -> Option<String> {
        let control = lock(&self.shared.control);
        control.reason.clone().filter(|_| control.state == of)
    }

    /// Trains up to `iterations` more, with the frames there are, and returns how many were done: fewer at the end of
    /// the run, or when the observer ends it, or [`Session::close`]. Views are calibrated, but not adjusted, and a single fit is made
    /// where `gaussians.fits` is 0: only training in the background refines the reconstruction.
    ///
    /// # Errors
    /// [`Error::Busy`] while it trains already, [`Error::NotReady`] without frames enough, [`Error::NoDevice`];
    /// [`Error::Diverged`]: the last good state stays; device errors.
    pub fn train(&self, iterations: u32, observe: &mut Observer<'_>) -> Result<u32> {
        self.not_from_observer()?;
        let _alone = self.alone()?;
        let trained = self.train_here(iterations, observe);
        self.shared.renews.store(false, Ordering::Release);
        trained
    }

    fn train_here(&self, iterations: u32, observe: &mut Observer<'_>) -> Result<u32> {
        let shared = &self.shared;
        shared.renews.store(true, Ordering::Release);
        let first = {
            let mut engine = shared.visit();
            shared.take_in_frames(&mut engine, || ())?;
            engine.start_clock();
            engine.step()
        };
        loop {
            shared.renew_viewer();
            let (progress, done) = {
                let mut engine = shared.visit();
                let length = engine.length();
                let end = length.min(first.saturating_add(iterations));
                let progress = shared.advance(&mut engine, end)?;
                (progress, engine.step() >= end)
            };
            let go_on = progress.is_none_or(|p| observe(&p));
            if done || !go_on || shared.long_work.is_closed() {
                let mut engine = shared.visit();
                shared.drain(&mut engine)?;
                return Ok(engine.step() - first);
            }
        }
    }

    /// Trains in the background until the run is done, paused or stopped; waits for frames while there are too few. At the end of the
    /// run, while the reconstruction so far is shown, the views are adjusted where `calibrate.adjust` is `auto`. Then training goes on with
    /// the corrected views, and with several fits where `gaussians.fits` is 0 and the data ask for their mean.
    ///
    /// # Errors
    /// [`Error::Busy`] when it trains already; [`Error::NoDevice`].
    pub fn start(&self, observe: Box<dyn FnMut(&Progress) -> bool + Send>) -> Result<()> {
        self.not_from_observer()?;
        let _alone = self.alone()?;
        self.shared.device()?;
        // A `stop` from another thread comes before all of this, or after it.
        let mut worker = lock(&self.worker);
        let shared = self.shared.clone();
        shared.stop.store(false, Ordering::Release);
        shared.pause.store(false, Ordering::Release);
        {
            let mut control = lock(&shared.control);
            (control.state, control.reason) = (State::Running, None);
        }
        let dispatch = tracing::dispatcher::get_default(Clone::clone);
        let spawned = std::thread::Builder::new().name(TRAINING_THREAD.into()).spawn(move || {
            tracing::dispatcher::with_default(&dispatch, || {
                lock(&shared.control).worker = Some(std::thread::current().id());
                // The observer is dropped before training is said to have ended: nothing of its owner's is used after that.
                let work = std::panic::AssertUnwindSafe(|| {
                    let mut observe = observe;
                    shared.work(&mut *observe)
                });
                let outcome =
                    std::panic::catch_unwind(work).unwrap_or_else(|_| Err(Error::Internal("training panicked".into())));
                let mut control = lock(&shared.control);
                control.worker = None;
                match outcome {
                    Ok(state) => (control.state, control.reason) = (state, None),
                    Err(error) => {
                        tracing::error!("training in the background failed: {error}");
                        (control.state, control.reason) = (State::Failed, Some(error.to_string()));
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
                return Err(Error::Internal(format!("a thread could not be started: {e}")));
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
        self.not_from_observer()?;
        let worker = lock(&self.worker);
        self.shared.stop.store(true, Ordering::Release);
        drop(lock(&self.shared.control));
        self.shared.changed.notify_all();
        join(worker);
        Ok(())
    }

    /// Acquires the right to train, or to change what is trained; refused while another caller has it.
    fn alone(&self) -> Result<MutexGuard<'_, ()>> {
        let blocking = match self.blocking.try_lock() {
            Ok(guard) => guard,
            Err(TryLockError::Poisoned(guard)) => guard.into_inner(),
            Err(TryLockError::WouldBlock) => {
                return Err(Error::Busy("another call is training this session".into()));
            }
        };
        // The session's state decides, since those who waited for the end go by it: the thread may take a moment longer.
        if self.state().in_background() {
            return Err(Error::Busy("the session is already training in the background".into()));
        }
        join(lock(&self.worker));
        Ok(blocking)
    }

    /// Refuses what would wait for the very thread it is called from.
    fn not_from_observer(&self) -> Result<()> {
        if lock(&self.shared.control).worker == Some(std::thread::current().id()) {
            return Err(Error::Busy(
                "an observer cannot start or stop training; it ends training by its return value".into(),
            ));
        }
        Ok(())
    }

    /// Waits until training in the background has ended, at most for `limit`; returns whether it has.
    pub fn wait(&self, limit: Duration) -> bool {
        let until = Instant::now() + limit;
        let mut control = lock(&self.shared.control);
        loop {
            if !control.state.in_background() {
                return true;
            }
            let Some(left) = until.checked_duration_since(Instant::now()).filter(|d| !d.is_zero()) else {
                return false;
            };
            control = self.shared.changed.wait_timeout(control, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    /// Draws a view through baked volumes, at display rates, also while training or long work goes on in other threads; see
    /// [`crate::render::live::Live::render`]. A `phase` may lie between two where moving Gaussians are the dynamic field.
    ///
    /// # Errors
    /// [`Error::NotReady`] before anything was trained or loaded; as [`crate::render::live::Live::render`].
    pub fn render(
        &self,
        rays: &ViewRays,
        size: (usize, usize),
        phase: impl Into<f64>,
        quantity: Quantity,
    ) -> Result<Vec<f32>> {
        let phase = phase.into();
        self.shared.with_viewer(phase, quantity, |live, at| live.render(at, rays, size, phase, quantity))
    }

    /// Draws a view as [`Session::render`] does, into a buffer on the device: `size.0` x `size.1` floats.
    ///
    /// # Errors
    /// As [`Session::render`]; [`Error::Internal`] when the buffer is too small.
    pub fn render_into(
        &self,
        target: &Buffer,
        rays: &ViewRays,
        size: (usize, usize),
        phase: impl Into<f64>,
        quantity: Quantity,
    ) -> Result<()> {
        let phase = phase.into();
        self.shared.with_viewer(phase, quantity, |live, at| live.render_into(target, at, rays, size, phase, quantity))
    }

    /// Returns which field the last live picture showed; none before the first one.
    pub fn drawn(&self) -> Option<Drawn> {
        *lock(&self.shared.drawn)
    }

    /// Draws a view through the fields themselves: slower, and exact. A `phase` may lie between two where the dynamic field is known
    /// there (see [`Renderer::render_at`]). Live pictures pass, as for all long work: [`Session::sample`], [`Session::trees`] and
    /// [`Session::evaluate`].
    ///
    /// # Errors
    /// As [`Session::render`] and [`Renderer::render_at`]; [`Error::Interrupted`] after [`Session::cancel`].
    pub fn render_fields(&self, rays: &ViewRays, size: (usize, usize), phase: f64) -> Result<Rendering> {
        self.shared.with_fields(|live, step| live.render_fields(step, rays, size, phase))
    }

    /// Attenuation per mm at the points of a grid, of a component at a phase.
    ///
    /// # Errors
    /// As [`Session::render_fields`] and [`crate::render::renderer::Renderer::sample_patient`].
    pub fn sample(&self, component: Component, phase: u32, grid: &PatientGrid) -> Result<Vec<f32>> {
        self.shared.with_fields(|live, step| live.renderer(step)?.sample_patient(component, phase, grid))
    }

    /// The vessels at all phases as trees of centrelines with radii, from the fields as they are after the iterations under
    /// way; see [`vessel_trees`] for the threshold and the minimum length.
    ///
    /// # Errors
    /// [`Error::NotReady`] before anything was trained or loaded; [`Error::Interrupted`] after [`Session::cancel`]; those of
    /// [`vessel_trees`].
    pub fn trees(&self, threshold_per_mm: Option<f64>, least_branch_mm: Option<f64>) -> Result<BeatTree> {
        self.trees_during(&self.shared.long_work.begin(), threshold_per_mm, least_branch_mm)
    }

    /// Finds [`Session::trees`] as a part of a longer call.
    fn trees_during(
        &self,
        call: &LongCall,
        threshold_per_mm: Option<f64>,
        least_branch_mm: Option<f64>,
    ) -> Result<BeatTree> {
        let (gpu, tuning) = self.shared.device()?;
        let model = self.checkpoint()?.model;
        let interlude = LongWork::interlude(gpu, &Arc::new(Mutex::new(call.clone())));
        let renderer = Renderer::new(gpu, &model, tuning.clone())?.in_slices(interlude);
        let phases = (0..model.shown_phases()).collect();
        let options = TreeOptions { phases, threshold_per_mm, least_branch_mm };
        let mut beat = vessel_trees(&renderer, &model, &options, |_, _| call.check())?;
        self.compare_with_images(&mut beat);
        Ok(beat)
    }

    /// States in a tree of the session the doubt about each point ([`crate::trees::doubt`]) and the training views, if training has begun
    /// here. A reason against it is logged.
    pub fn compare_with_images(&self, beat: &mut BeatTree) {
        let Some(calibration) = self.calibration() else { return };
        let dataset = lock(&self.shared.inbox).training_dataset();
        match dataset.and_then(|(dataset, _)| dataset.corrected(&calibration)) {
            Ok(dataset) if dataset.n_phases as usize == beat.phases.len() => {
                if let Some(reason) = compare_with_views(beat, &dataset, Some(calibration.disagreement_px)) {
                    tracing::info!("the radii of vessels are those of the field: {reason}");
                }
            }
            Ok(_) => tracing::warn!("doubt is not stated: the frames have another number of phases than the field"),
            Err(error) => tracing::warn!("doubt is not stated: {error}"),
        }
    }

    /// Cancels the long work that is under way in other threads: scores, trees, volumes and exact pictures. It ends with
    /// [`Error::Interrupted`] before its next slice; work that begins later is not affected.
    pub fn cancel(&self) {
        self.shared.long_work.cancel();
    }

    /// Ends training, in the background and in other threads, after the iterations under way, and long work in other threads as
    /// [`Session::cancel`] does, also long work that begins later.
    ///
    /// # Errors
    /// As [`Session::stop`].
    pub fn close(&self) -> Result<()> {
        self.stop()?;
        self.shared.long_work.close();
        Ok(())
    }

    /// Tells whether [`Session::close`] was called.
    pub fn is_closed(&self) -> bool {
        self.shared.long_work.is_closed()
    }

    /// Calls a function before each slice of long work, in the thread that does the work, from the next call on: a place for work
    /// that must not wait.
    pub fn on_slices(&self, observer: Option<Arc<dyn Fn() + Send + Sync>>) {
        self.shared.long_work.observe(observer);
    }

    /// Everything needed to continue, after the iterations under way.
    ///
    /// # Errors
    /// [`Error::NotReady`] before anything was trained or loaded; device errors.
    pub fn checkpoint(&self) -> Result<Checkpoint> {
        let mut engine = self.shared.visit();
        let engine = &mut *engine;
        match (&mut engine.training, &engine.saved) {
            (Some(training), _) => training.trainer_mut().checkpoint(),
            (None, Some(saved)) => Ok(saved.clone()),
            (None, None) => Err(nothing_yet()),
        }
    }

    /// Takes over a checkpoint with its hyper-parameters; training continues from it with the frames of this session.
    ///
    /// # Errors
    /// [`Error::Busy`] while it trains; [`Error::Config`] when frames of more phases were added already.
    pub fn load(&self, checkpoint: Checkpoint) -> Result<()> {
        let _alone = self.alone()?;
        let model = &checkpoint.model;
        let mut engine = self.shared.visit();
        let mut inbox = lock(&self.shared.inbox);
        let (phases, still) = (model.param_map.phases as u32, model.scene.still);
        if inbox.options.phases != phases && !inbox.frames.is_empty() {
            let problem = format!("the session has frames of a beat of {} phases", inbox.options.phases);
            return Err(Error::config("checkpoint: phases", phases, problem));
        }
        if inbox.options.still != still && !inbox.frames.is_empty() {
            let problem = format!("the session has frames of an object for which it is {}", inbox.options.still);
            return Err(Error::config("checkpoint: still", still, problem));
        }
        (inbox.options.phases, inbox.options.still) = (phases, still);
        inbox.options.config = model.config.clone();
        engine.training = None;
        engine.unrefined = None;
        engine.version = 0;
        *lock(&self.shared.calibration) = None;
        self.shared.publish(Source::of(model), Some(0));
        self.shared.step.store(model.step, Ordering::Release);
        lock(&self.shared.control).state = State::Idle;
        engine.saved = Some(checkpoint);
        Ok(())
    }
}

/// Returns the number of phases of an object at rest.
///
/// # Errors
/// [`Error::Config`] where more are given.
fn phases_at_rest(given: u32) -> Result<u32> {
    if given > at_rest::PHASES {
        let problem = "an object at rest has phase 0 and, where they are known, images without vessels as phase 1";
        return Err(Error::config("phases", given, problem));
    }
    Ok(at_rest::PHASES)
}

/// Waits for the thread that trains; other callers that wait for it get the lock after that.
fn join(mut worker: MutexGuard<'_, Option<JoinHandle<()>>>) {
    if let Some(handle) = worker.take() {
        // A panic of the worker has become its failure.
        let _ = handle.join();
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        // Only an observer that owns the session could fail here, and then the thread is its own.
        let _ = self.stop();
    }
}
