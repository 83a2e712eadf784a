//! A run's state on its way to the host, beside the iterations that follow.

use crate::error::{Error, Result};
use crate::fitting::fit::FitState;
use crate::fitting::losses::SMALLER_STEPS;
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::{Commands, Ticket};
use crate::kernels::layout::{DeviceState, StepReport};
use crate::model::Model;
use crate::model::checkpoint::{Checkpoint, LossScale};
use std::sync::Arc;

/// Bytes of an iteration's report.
pub(super) const REPORT_BYTES: u64 = size_of::<StepReport>() as u64;

/// State of fields on its way to the host.
pub(super) struct FieldsSnapshot {
    pub(super) gpu: Gpu,
    pub(super) ticket: Ticket,
    pub(super) _commands: Commands,
    pub(super) params: Buffer,
    pub(super) moments: Buffer,
    pub(super) state: Buffer,
    pub(super) report: Buffer,
    pub(super) occupancy: Buffer,
    pub(super) occupancy_words: usize,
    pub(super) scaled: bool,
}

/// A run's state on its way to the host.
pub struct Snapshot {
    pub(super) model: Model,
    /// Fields that rays are marched through; none for other methods, whose state is in `fit`.
    pub(super) fields: Option<FieldsSnapshot>,
    pub(super) fit: Option<Arc<dyn FitState>>,
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
    /// [`Error::Diverged`] when a parameter is not finite; device errors.
    pub fn wait(self) -> Result<Checkpoint> {
        let checkpoint = Checkpoint {
            model: self.model,
            moments: Vec::new(),
            occupancy: Vec::new(),
            loss_scale: None,
            stopped: false,
            last_report: Vec::new(),
            fit: self.fit,
            data_fingerprint: self.data_fingerprint,
        };
        match self.fields {
            Some(fields) => fields.wait(checkpoint),
            None => Ok(checkpoint),
        }
    }
}

impl FieldsSnapshot {
    /// Waits until the device has come this far, and completes the checkpoint.
    fn wait(self, mut checkpoint: Checkpoint) -> Result<Checkpoint> {
        self.gpu.wait(self.ticket)?;
        let n = checkpoint.model.param_map.len;
        let mut params = vec![0f32; n];
        self.params.read(&mut params)?;
        if let Some(bad) = params.iter().find(|p| !p.is_finite()) {
            let (step, value) = (u64::from(checkpoint.model.step), f64::from(*bad));
            return Err(Error::Diverged { step, quantity: "parameter", value, advice: SMALLER_STEPS });
        }
        checkpoint.model.params = params;
        checkpoint.moments = vec![[0f32; 2]; n];
        self.moments.read(&mut checkpoint.moments)?;
        let mut state = [DeviceState::default()];
        self.state.read(&mut state)?;
        checkpoint.occupancy = vec![0u32; self.occupancy_words];
        self.occupancy.read(&mut checkpoint.occupancy)?;
        let [DeviceState { loss_scale: scale, good_updates, return_scale, stopped, .. }] = state;
        checkpoint.stopped = stopped != 0;
        if checkpoint.stopped {
            checkpoint.last_report = vec![0u32; REPORT_BYTES as usize / 4];
            self.report.read(&mut checkpoint.last_report)?;
        }
        checkpoint.loss_scale = self.scaled.then_some(LossScale { scale, good_updates, return_scale });
        Ok(checkpoint)
    }
}
