//! Refinement of a reconstruction that training has ended with: views are adjusted, and fits are repeated.

use crate::calibrate::correction::Calibration;
use crate::error::{Error, Result};
use crate::fitting::fit::{FitField, Start, Use};
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::plan::Plan;
use crate::prepare::Prepared;
use crate::session::state::{Shared, lock};
use crate::train::trainer::Trainer;
use std::sync::atomic::Ordering;

/// Training after the refinement has been prepared.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum AfterTraining {
    /// Nothing is to be refined, so that training has ended.
    Ended,
    /// Training goes on, with corrected views or with several fits.
    TrainsOn,
}

impl Shared {
    /// Refines the reconstruction of the frames that training has ended with, `version` of the inbox, once: it adjusts the views, and begins
    /// the fits whose mean is the dynamic field, where the data ask for several. The reconstruction so far is shown meanwhile.
    ///
    /// # Errors
    /// [`Error::Interrupted`] where frames have changed meanwhile, or training is to stop or to pause; device errors.
    pub(super) fn refine(&self, version: u64) -> Result<AfterTraining> {
        let (gpu, tuning) = self.device()?;
        if lock(&self.engine).refined == version {
            return Ok(AfterTraining::Ended);
        }
        let (stated, mut config) = {
            let inbox = lock(&self.inbox);
            (inbox.training_dataset()?.0, inbox.refining_config())
        };
        let tuning = beside_pictures(gpu, tuning);
        config.train.iterations_per_submit = tuning.iterations_per_submit.unwrap_or(config.train.iterations_per_submit);
        let calibration = lock(&self.calibration).clone().unwrap_or_else(|| Calibration::none(None));
        let mut told = 0;
        let mut observe = |share: f64| {
            gpu.looks().give_way();
            self.goes_on(version)?;
            let tenths = (10.0 * share) as u32;
            if tenths > told {
                told = tenths;
                tracing::info!("adjusting views, {:.0} %", 100.0 * share);
            }
            Ok(())
        };
        let views = Prepared::known(calibration).adjusted(gpu, &config, &stated, &mut observe)?;
        views.calibration.adjustment.iter().for_each(|record| tracing::info!("{}", record.describe()));
        self.goes_on(version)?;
        let are_adjusted = views.are_adjusted();
        let Prepared { calibration, made } = views;
        if !are_adjusted && !lock(&self.engine).repeats {
            lock(&self.engine).refined = version;
            *lock(&self.calibration) = Some(calibration);
            return Ok(AfterTraining::Ended);
        }
        let dataset = stated.corrected(&calibration)?;
        let plan = match Plan::new(&config, &dataset) {
            Err(why @ (Error::Config { .. } | Error::Unmet { .. } | Error::Data { .. })) => {
                tracing::warn!(
                    "the views stay as they are, because nothing can be fitted to the corrected ones: {why}"
                );
                lock(&self.engine).refined = version;
                return Ok(AfterTraining::Ended);
            }
            plan => plan?,
        };
        let mut engine = lock(&self.engine);
        self.goes_on(version)?;
        // The reconstruction so far stays until the new one is saved; the memory of its trainer is needed.
        if let Some(training) = &mut engine.training {
            let state = training.trainer_mut().checkpoint()?;
            engine.unrefined = Some(state.clone());
            engine.saved = Some(state);
        }
        engine.training = None;
        self.free_fields();
        let shown = engine.saved.as_ref().and_then(|saved| saved.model.gaussians.clone()).map(FitField::of_gaussians);
        let field = shown.as_ref().map(|shown| (shown, Use::Show));
        let trainer = Trainer::begin(gpu, plan, &dataset, tuning, Start { field, state: None, made: made.as_ref() })?;
        trainer.plan().notes.iter().for_each(|note| tracing::info!("{note}"));
        engine.refined = version;
        *lock(&self.calibration) = Some(calibration);
        self.show(&mut engine, trainer)?;
        Ok(AfterTraining::TrainsOn)
    }

    /// Returns an error where the frames are no longer those of `version`, or training is to stop or to pause.
    fn goes_on(&self, version: u64) -> Result<()> {
        let ends = self.stop.load(Ordering::Acquire) || self.pause.load(Ordering::Acquire);
        let is_current = self.version.load(Ordering::Acquire) == version;
        if ends || !is_current { Err(Error::Interrupted) } else { Ok(()) }
    }
}

/// Returns the tuning of work beside which pictures are drawn.
pub(super) fn beside_pictures(gpu: &Gpu, tuning: &Tuning) -> Tuning {
    let mut tuning = tuning.clone();
    if gpu.info().is_cpu() {
        // Views wait for what was submitted before them.
        tuning.iterations_per_submit = Some(1);
    }
    tuning
}
