//! State of a fit of fields beside their parameters: as a checkpoint keeps it, on its way to the host, and as tensors of a file.

use crate::config::fields::FieldSettings;
use crate::error::{Error, Result};
use crate::fitting::fit::{FitField, FitState, SavedAt, SavedFit, SavedState};
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::{Commands, Ticket};
use crate::kernels::layout::{DeviceState, StepReport};
use crate::model::Model;
use crate::model::hull::Hull;
use crate::model::params::ParamMap;
use crate::tensors::{File, FileTensor};
use safetensors::tensor::Dtype;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Bytes of an iteration's report.
pub(super) const REPORT_BYTES: u64 = size_of::<StepReport>() as u64;
/// Format of checkpoints of fields.
pub const FORMAT: &str = "nertca-checkpoint-2";
const OCCUPANCY: &str = "occupancy.bits";
const LAST_REPORT: &str = "report.words";
/// Prefixes of the tensors of a parameter tensor, of its first and of its second moments.
const PREFIXES: [&str; 3] = ["", "adam.m.", "adam.v."];

/// State of a fit of fields beside their parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldsState {
    /// Iterations done.
    pub step: u32,
    /// Adam's first and second moment of each parameter, padded like the parameters.
    pub moments: Vec<[f32; 2]>,
    /// Occupancy of three epochs, in the layout of the shaders; empty for a run without occupancy.
    pub occupancy: Vec<u32>,
    /// Loss scale of a run on matrix units.
    pub loss_scale: Option<LossScale>,
    /// Whether learning ended before the end of the run because an entropy of two networks vanished.
    pub stopped: bool,
    /// Words of the last [`StepReport`], which a run whose learning has ended repeats; empty while it learns.
    pub last_report: Vec<u32>,
}

impl FieldsState {
    /// Returns the state of `n_params` parameters that have not been updated, after `step` iterations.
    pub fn fresh(step: u32, n_params: usize) -> FieldsState {
        FieldsState {
            step,
            moments: vec![[0.0; 2]; n_params],
            occupancy: Vec::new(),
            loss_scale: None,
            stopped: false,
            last_report: Vec::new(),
        }
    }
}

/// Factor on gradients in f16, and the number of updates since its last change.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct LossScale {
    /// The factor.
    pub scale: f32,
    /// Number of updates since the factor changed, including the update at which it grew.
    pub good_updates: u32,
    /// Scale to which the factor returns quickly after overflows; 0 = none yet, as in older checkpoints.
    #[serde(default)]
    pub return_scale: f32,
}

/// Sections of a checkpoint's header that belong to the state.
#[derive(Deserialize)]
struct Sections {
    #[serde(default)]
    loss_scale: Option<LossScale>,
    #[serde(default)]
    stopped: bool,
}

impl FitState for FieldsState {
    fn saved(&self, model: &Model) -> Result<SavedState> {
        let mut tensors: Vec<FileTensor> = Vec::new();
        for tensor in model.param_map.tensors() {
            let gather = |value: &dyn Fn(usize) -> f32| -> Vec<u8> {
                tensor.positions.iter().flat_map(|at| value(*at as usize).to_le_bytes()).collect()
            };
            let [value, first, second] = PREFIXES.map(|prefix| format!("{prefix}{}", tensor.name));
            for (name, bytes) in [
                (value, gather(&|at| model.params[at])),
                (first, gather(&|at| self.moments[at][0])),
                (second, gather(&|at| self.moments[at][1])),
            ] {
                tensors.push((name, Dtype::F32, tensor.shape.clone(), bytes));
            }
        }
        for (name, words) in [(OCCUPANCY, &self.occupancy), (LAST_REPORT, &self.last_report)] {
            if !words.is_empty() {
                let bytes = words.iter().flat_map(|w| w.to_le_bytes()).collect();
                tensors.push((name.into(), Dtype::U32, vec![words.len()], bytes));
            }
        }
        let mut sections = Vec::new();
        if let Some(scale) = self.loss_scale {
            sections.push(("loss_scale", serde_json::to_string(&scale).map_err(|e| Error::Internal(e.to_string()))?));
        }
        if self.stopped {
            sections.push(("stopped", "true".into()));
        }
        Ok(SavedState { tensors, sections })
    }
}

/// Reads parameters and state from a checkpoint, whose header has these `sections`.
///
/// # Errors
/// [`Error::Data`] naming what is missing, misshapen or not finite.
pub fn read(sections: &serde_json::Value, settings: &FieldSettings, at: SavedAt, file: &File<'_>) -> Result<SavedFit> {
    let bad = |field: &str, problem: String| Error::data(file.path, field, problem);
    let header: Sections = Deserialize::deserialize(sections).map_err(|e| bad("metadata", e.to_string()))?;
    if let Some(LossScale { scale, .. }) = header.loss_scale.filter(|s| !(s.scale.is_finite() && s.scale >= 1.0)) {
        return Err(bad("loss_scale", format!("is {scale} where at least 1 is needed")));
    }
    check_size(settings, at, file)?;
    let map = ParamMap::of(Some(settings), at.n_phases);
    let (mut params, mut moments) = (vec![0f32; map.len], vec![[0f32; 2]; map.len]);
    for tensor in map.tensors() {
        let shape: Vec<Option<usize>> = tensor.shape.iter().copied().map(Some).collect();
        let [values, first, second] = PREFIXES.map(|prefix| format!("{prefix}{}", tensor.name));
        let (values, first, second) =
            (file.floats(&values, &shape)?, file.floats(&first, &shape)?, file.floats(&second, &shape)?);
        for ((at, value), moment) in tensor.positions.iter().zip(values).zip(first.into_iter().zip(second)) {
            params[*at as usize] = value;
            moments[*at as usize] = moment.into();
        }
    }
    let state = FieldsState {
        step: at.step,
        moments,
        occupancy: words(OCCUPANCY, file),
        loss_scale: header.loss_scale,
        stopped: header.stopped,
        last_report: words(LAST_REPORT, file),
    };
    Ok(SavedFit { field: FitField { params, ..FitField::default() }, state: Arc::new(state) })
}

/// Refuses a configuration that asks for more parameters than a file holds, before memory is reserved for them.
fn check_size(settings: &FieldSettings, at: SavedAt, file: &File<'_>) -> Result<()> {
    let network = settings.network.as_ref().map_or(0, |n| u64::from(n.layers) * u64::from(n.width).pow(2));
    let latents = settings.network.as_ref().map_or(0, |n| at.n_phases as u64 * u64::from(n.latent));
    let static_len = settings.static_field.tensor().map_or(network, |tensor| {
        let [grid, ranks] = [tensor.grid, tensor.ranks].map(u64::from);
        3 * ranks * grid * (grid + 1)
    });
    let needed = static_len + network + latents;
    let bytes: usize = file.tensors.iter().map(|(_, tensor)| tensor.data().len()).sum();
    if needed > bytes as u64 / 4 {
        let problem = format!("{needed} parameters do not fit into the file's {bytes} bytes of tensors");
        return Err(Error::data(file.path, "config", problem));
    }
    Ok(())
}

/// Returns the words of a tensor that only some files have; none where it is missing.
fn words(name: &str, file: &File<'_>) -> Vec<u32> {
    match file.tensors.tensor(name) {
        Ok(view) if view.dtype() == Dtype::U32 => {
            view.data().chunks_exact(4).map(|w| u32::from_le_bytes([w[0], w[1], w[2], w[3]])).collect()
        }
        _ => Vec::new(),
    }
}

/// Fields and their state on their way to the host.
pub(crate) struct PendingFields {
    pub(super) gpu: Gpu,
    pub(super) ticket: Ticket,
    pub(super) _commands: Commands,
    pub(super) step: u32,
    pub(super) hull: Option<Hull>,
    pub(super) n_params: usize,
    pub(super) params: Buffer,
    pub(super) moments: Buffer,
    pub(super) state: Buffer,
    pub(super) report: Buffer,
    pub(super) occupancy: Buffer,
    pub(super) occupancy_words: usize,
    pub(super) scaled: bool,
    /// Advice for a run that diverged.
    pub(super) advice: &'static str,
}

impl PendingFields {
    /// Waits until the device has come this far.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a parameter is not finite; device errors.
    pub(crate) fn wait(self) -> Result<SavedFit> {
        self.gpu.wait(self.ticket)?;
        let mut params = vec![0f32; self.n_params];
        self.params.read(&mut params)?;
        if let Some(bad) = params.iter().find(|p| !p.is_finite()) {
            let (step, value) = (u64::from(self.step), f64::from(*bad));
            return Err(Error::Diverged { step, quantity: "parameter", value, advice: self.advice });
        }
        let mut moments = vec![[0f32; 2]; self.n_params];
        self.moments.read(&mut moments)?;
        let mut state = [DeviceState::default()];
        self.state.read(&mut state)?;
        let mut occupancy = vec![0u32; self.occupancy_words];
        self.occupancy.read(&mut occupancy)?;
        let [DeviceState { loss_scale: scale, good_updates, return_scale, stopped, .. }] = state;
        let stopped = stopped != 0;
        let mut last_report = vec![0u32; if stopped { REPORT_BYTES as usize / 4 } else { 0 }];
        if stopped {
            self.report.read(&mut last_report)?;
        }
        let loss_scale = self.scaled.then_some(LossScale { scale, good_updates, return_scale });
        let state = FieldsState { step: self.step, moments, occupancy, loss_scale, stopped, last_report };
        let field = FitField { params, hull: self.hull, ..FitField::default() };
        Ok(SavedFit { field, state: Arc::new(state) })
    }
}
