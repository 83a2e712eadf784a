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
use crate::model::r2::R2State;
use crate::model::x_gaussian::XState;
use std::sync::Arc;

/// Bytes of an iteration's report.
pub(super) const REPORT_BYTES: u64 = size_of::<StepReport>() as u64;

/// A run's state on its way to the host.
pub struct Snapshot {
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
    pub(super) model: Model,
    pub(super) r2: Option<R2State>,
    pub(super) x: Option<XState>,
    pub(super) fit: Option<Arc<dyn FitState>>,
    pub(super) data_fingerprint: String,
}

impl Snapshot {
    /// Iterations it holds.
    pub fn step(&self) -> u32 {
        self.model.step
    }

    /// Waits until the device has come this far.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a parameter is not finite; device errors.
    pub fn wait(mut self) -> Result<Checkpoint> {
        self.gpu.wait(self.ticket)?;
        let n = self.model.param_map.len;
        let mut params = vec![0f32; n];
        self.params.read(&mut params)?;
        if let Some(bad) = params.iter().find(|p| !p.is_finite()) {
            let (step, value) = (u64::from(self.model.step), f64::from(*bad));
            return Err(Error::Diverged { step, quantity: "parameter", value, advice: SMALLER_STEPS });
        }
        self.model.params = params;
        let mut moments = vec![[0f32; 2]; n];
        self.moments.read(&mut moments)?;
        let mut state = [DeviceState::default()];
        self.state.read(&mut state)?;
        let mut occupancy = vec![0u32; self.occupancy_words];
        self.occupancy.read(&mut occupancy)?;
        let [DeviceState { loss_scale: scale, good_updates, return_scale, stopped, .. }] = state;
        let mut last_report = Vec::new();
        if stopped != 0 {
            last_report.resize(REPORT_BYTES as usize / 4, 0u32);
            self.report.read(&mut last_report)?;
        }
        Ok(Checkpoint {
            model: self.model,
            moments,
            occupancy,
            loss_scale: self.scaled.then_some(LossScale { scale, good_updates, return_scale }),
            stopped: stopped != 0,
            last_report,
            r2: self.r2,
            x: self.x,
            fit: self.fit,
            data_fingerprint: self.data_fingerprint,
        })
    }
}
