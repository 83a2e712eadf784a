//! Fits of static methods whose field consists of Gaussians, which are drawn while the fit runs.

use crate::error::Result;
use crate::fitting::fit::{
    Advance, FieldFeed, Fit, FitField, FitProgress, FitState, FitWork, Iterates, Measured, PendingFit, SavedFit,
};
use crate::fitting::losses::StepLoss;
use crate::gaussians::field::{GaussianFeed, GaussianField, Gaussians};
use crate::gaussians::work::GaussianWork;
use crate::gpu::record::PassTime;
use std::sync::{Arc, Mutex, PoisonError};

/// Iterations between updates of the Gaussians that are drawn: with half a million Gaussians per phase an update takes as long as
/// some iterations.
const SHOWN_EVERY: u32 = 100;

/// Fit of the Gaussians of all sets of a static method.
pub trait SetsFit: Send {
    /// State of the Gaussians and of their optimiser.
    type State: FitState + 'static;

    /// Returns the number of iterations done.
    fn step(&self) -> u32;

    /// Returns the number of Gaussians of all sets.
    fn count(&self) -> u32;

    /// Runs one submit of iterations towards `until`, at most to where the number of Gaussians changes, and returns their losses,
    /// each the mean over the sets; none when `until` was reached before.
    ///
    /// # Errors
    /// [`crate::error::Error::Diverged`] on a loss that is not finite; [`crate::error::Error::Config`] where no buffer of the
    /// device holds what an iteration needs; [`crate::error::Error::NoDevice`] of a device that does not count its iterations;
    /// device errors.
    fn advance(&mut self, until: u32) -> Result<Vec<f64>>;

    /// Returns the state after the iterations done.
    ///
    /// # Errors
    /// [`crate::error::Error::Diverged`] when a parameter is not finite; device errors.
    fn state(&self) -> Result<Self::State>;

    /// Returns the Gaussians of a state in the units that they are drawn and exported in.
    fn field_of(&self, state: &Self::State) -> Gaussians;

    /// Returns the Gaussians after the iterations done, in the units that they are drawn and exported in.
    ///
    /// # Errors
    /// Errors of [`SetsFit::state`].
    fn model(&self) -> Result<Gaussians> {
        Ok(self.field_of(&self.state()?))
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when the fit is over; device errors.
    fn profile_step(&mut self) -> Result<Vec<PassTime>>;

    /// Returns the work of the last iteration.
    ///
    /// # Errors
    /// Device errors.
    fn work(&self) -> Result<GaussianWork>;
}

/// A fit under way, and the Gaussians that are drawn of it.
pub struct ShownFit<T> {
    fit: T,
    feed: GaussianFeed,
}

impl<T: SetsFit> ShownFit<T> {
    /// Shows the Gaussians as they are now.
    ///
    /// # Errors
    /// Errors of [`SetsFit::state`].
    pub fn new(fit: T) -> Result<ShownFit<T>> {
        let field = fit.model()?;
        Ok(ShownFit { fit, feed: Arc::new(Mutex::new((0, GaussianField::PerPhase(field)))) })
    }
}

/// Tells whether the field after iteration `now` is to be drawn, when the last submit began after iteration `before` and the run
/// stops at `until`.
fn is_due(before: u32, now: u32, until: u32) -> bool {
    now >= until || now / SHOWN_EVERY > before / SHOWN_EVERY
}

impl<T: SetsFit + 'static> Iterates for ShownFit<T> {
    fn progress(&self) -> FitProgress {
        FitProgress::at(self.fit.step())
    }

    fn advance(&mut self, until: u32) -> Result<Advance> {
        let before = self.fit.step();
        let losses = self.fit.advance(until)?;
        if is_due(before, self.fit.step(), until) {
            let field = self.fit.model()?;
            let mut feed = self.feed.lock().unwrap_or_else(PoisonError::into_inner);
            *feed = (feed.0 + 1, GaussianField::PerPhase(field));
        }
        Ok(Advance::of(
            losses.into_iter().zip(before + 1..).map(|(loss, step)| StepLoss::of_gaussians(step, loss)).collect(),
        ))
    }
}

impl<T: SetsFit + 'static> Fit for ShownFit<T> {
    fn outline(&self) -> FitField {
        let shown = self.feed.lock().unwrap_or_else(PoisonError::into_inner).1.clone();
        FitField::of_gaussians(shown)
    }

    fn feed(&self) -> FieldFeed {
        FieldFeed { gaussians: Some(self.feed.clone()), ..FieldFeed::default() }
    }

    fn snapshot(&self) -> Result<PendingFit> {
        let state = self.fit.state()?;
        let field = GaussianField::PerPhase(self.fit.field_of(&state));
        let saved = SavedFit { field: FitField::of_gaussians(field), state: Arc::new(state) };
        Ok(Box::new(|| Ok(saved)))
    }

    fn measured(&mut self) -> Option<&mut dyn Measured> {
        Some(self)
    }
}

impl<T: SetsFit + 'static> Measured for ShownFit<T> {
    fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        self.fit.profile_step()
    }

    fn work(&self) -> Result<Option<FitWork>> {
        Ok(Some(FitWork { form: None, count: self.fit.count(), work: self.fit.work()? }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_are_shown_every_hundred_iterations_and_at_the_end() {
        assert!(is_due(90, 100, 1000) && is_due(95, 205, 1000) && is_due(3, 7, 7));
        assert!(!is_due(0, 10, 1000) && !is_due(100, 110, 1000));
    }
}
