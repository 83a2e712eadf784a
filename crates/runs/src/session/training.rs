//! Training of a session: new frames are taken in, and iterations run in the background.

use crate::error::{Error, Result};
use crate::fitting::fit::{FitField, Start, Use};
use crate::methods;
use crate::model::Model;
use crate::model::scene::Scene;
use crate::plan::Plan;
use crate::prepare::Prepared;
use crate::render::live::Source;
use crate::session::progress::{Observer, Progress, State};
use crate::session::refining::{AfterTraining, beside_pictures};
use crate::session::state::{Engine, Settling, Shared, Viewer, lock};
use crate::train::trainer::Trainer;
use crate::train::training::Training;
use std::sync::PoisonError;
use std::sync::atomic::Ordering;
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

impl Shared {
    /// Brings the trainer up to the frames there are; `begin` is called when there are enough new ones.
    pub(super) fn take_in_frames(&self, engine: &mut Engine, begin: impl FnOnce()) -> Result<()> {
        let (gpu, tuning) = self.device()?;
        let version = self.version.load(Ordering::Acquire);
        if engine.version == version && engine.training.is_some() {
            return Ok(());
        }
        let started = Instant::now();
        let ((dataset, taken), config, refining_config, left_out) = {
            let inbox = lock(&self.inbox);
            let left_out = inbox.leaves_out().then(|| inbox.why_left_out());
            (inbox.training_dataset()?, inbox.training_config(), inbox.refining_config(), left_out)
        };
        begin();
        if let Some(why) = left_out {
            tracing::info!("some frames are not used: {why}");
        }
        let tuning = beside_pictures(gpu, tuning);
        dataset.notes.iter().for_each(|note| tracing::info!("{note}"));
        let calibration = Prepared::calibrated(&dataset, config.calibration())?.calibration;
        calibration.notes.iter().for_each(|note| tracing::info!("{note}"));
        let dataset = dataset.corrected(&calibration)?;
        let fresh = Plan::new(&config, &dataset)?;
        let repeats = fresh.fits(&refining_config) > fresh.fits(&config);
        let mut earlier = None;
        let unrefined = engine.unrefined.take();
        if let Some(training) = &mut engine.training {
            // Fits with other frames cannot go on from the mean of several, nor from one to views that are calibrated anew.
            let mut state = match unrefined {
                Some(state) => state,
                None => training.trainer_mut().checkpoint()?,
            };
            let fits = holds(&state.model, &fresh.scene);
            if !fits {
                tracing::warn!(
                    "new frames show vessels outside the box that was trained so far, so training starts again"
                );
                earlier = state.model.gaussians.take().map(FitField::of_gaussians);
            }
            engine.saved = fits.then_some(state);
        }
        (engine.training, engine.version) = (None, 0); // its memory is needed
        self.free_fields();
        let trainer = match &engine.saved {
            None => {
                let field = earlier.as_ref().map(|earlier| (earlier, Use::GoOn));
                Trainer::begin(gpu, fresh, &dataset, tuning, Start { field, ..Start::default() })?
            }
            Some(state) => {
                let plan = if methods::of(&config).boxes_hold_all_rays {
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
        (engine.version, engine.refined, engine.repeats) = (version, 0, repeats);
        *lock(&self.taken) = taken;
        let took = started.elapsed();
        engine.settling = Some(Settling { until: Instant::now() + took * SETTLE, quiet: took.max(QUIET) });
        self.show(engine, trainer)
    }

    /// Trains and shows a trainer from now on.
    pub(super) fn show(&self, engine: &mut Engine, trainer: Trainer) -> Result<()> {
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
                match self.refine(version) {
                    Ok(AfterTraining::Ended) => return Ok(State::Finished),
                    Ok(AfterTraining::TrainsOn) | Err(Error::Interrupted) => continue,
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
    let inside = methods::of(&model.config).boxes_hold_all_rays || (0..3).all(within);
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
