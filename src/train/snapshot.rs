//! A run's state on its way to the host, beside the iterations that follow.

use crate::checkpoint::Checkpoint;
use crate::error::Result;
use crate::fitting::fit::{FitField, PendingFit, SavedFit};
use crate::model::Model;

/// A run's state on its way to the host.
pub struct Snapshot {
    /// The model without its field.
    pub(super) model: Model,
    pub(super) fit: PendingFit,
    pub(super) data_fingerprint: String,
}

impl Snapshot {
    /// Returns the number of iterations that it contains.
    pub fn step(&self) -> u32 {
        self.model.step
    }

    /// Waits until the device has come this far.
    ///
    /// # Errors
    /// [`crate::error::Error::Diverged`] when a parameter is not finite; device errors.
    pub fn wait(self) -> Result<Checkpoint> {
        let SavedFit { field: FitField { params, hull, gaussians, own }, state } = (self.fit)()?;
        let model = Model { params, hull, gaussians, field: own, ..self.model };
        Ok(Checkpoint { model, fit: state, data_fingerprint: self.data_fingerprint })
    }
}
