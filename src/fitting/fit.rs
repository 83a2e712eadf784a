//! Fits of methods to a dataset.

use crate::config::Config;
use crate::error::Result;
use crate::fitting::field::Field;
use crate::fitting::losses::StepLoss;
use crate::fitting::tensors::{File, FileTensor};
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::scan::dataset::Dataset;
use std::any::Any;
use std::fmt::Debug;
use std::sync::Arc;

/// A method of reconstruction with settings, data, stages and a field of its own.
pub trait Method: Sync {
    /// Returns the key of the method, which names its settings and its field in headers of checkpoints.
    fn key(&self) -> &'static str;

    /// Returns the name of the format of the method's checkpoints.
    fn checkpoint_format(&self) -> &'static str;

    /// Tells whether a configuration chooses this method.
    fn is_chosen(&self, config: &Config) -> bool;

    /// Prepares the data of a fit and appends remarks about them to `notes`.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] when dataset and configuration do not fit.
    fn plan(&self, config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<Box<dyn FitData>>;

    /// Returns the volume that the field fills.
    fn volume(&self, config: &Config, dataset: &Dataset) -> FieldVolume;

    /// Reads the field and the state of its fit from a checkpoint, whose header has `about` under the method's key.
    ///
    /// # Errors
    /// [`crate::error::Error::Data`] naming what is missing, misshapen or not finite.
    fn read(&self, about: &serde_json::Value, config: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit>;

    /// Returns the rays of an iteration.
    fn rays_per_iteration(&self, config: &Config) -> u32;

    /// Lowers the learning rates by a factor, for measurements whose field is to stay as it is.
    fn lower_rates(&self, config: &mut Config, factor: f64);

    /// Returns the settings that make the method's steps smaller, as advice for a run that diverged.
    fn smaller_steps(&self) -> &'static str;

    /// Builds all pipelines, for the inventory of compiled pipelines.
    ///
    /// # Errors
    /// Device errors.
    fn make_pipelines(&self, gpu: &Gpu) -> Result<()>;
}

/// Volume that a field fills.
#[derive(Debug, Clone, Copy)]
pub struct FieldVolume {
    /// Half side of a cube around the isocentre, world units.
    pub half: f64,
    /// Attenuation per world unit that is the unit of the field's volumes.
    pub attenuation: f64,
}

/// Number of phases of the run and iteration at which a checkpoint was saved.
#[derive(Debug, Clone, Copy)]
pub struct SavedAt {
    /// Cardiac phases.
    pub n_phases: usize,
    /// Iterations done.
    pub step: u32,
}

/// A field, and the state from which its fit is resumed.
#[derive(Debug, Clone)]
pub struct SavedFit {
    /// The field.
    pub field: Arc<dyn Field>,
    /// State of the optimiser.
    pub state: Arc<dyn FitState>,
}

/// State of a fit beside its field.
pub trait FitState: Debug + Send + Sync {
    /// Returns field and state as tensors of a checkpoint.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] for a field of another method.
    fn tensors(&self, field: &dyn Field) -> Result<Vec<FileTensor>>;

    /// Returns the state as its own type, for its method.
    fn as_any(&self) -> &dyn Any;
}

/// Data that a method is fitted to.
pub trait FitData: Send {
    /// Begins a fit, or resumes a `saved` fit to the same data.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] for impossible settings, for a `saved` fit of other sizes and where memory does not suffice;
    /// device errors.
    fn begin(self: Box<Self>, gpu: &Gpu, config: &Config, saved: Option<&SavedFit>) -> Result<Box<dyn Fit>>;

    /// Returns the data as their own type, for their method.
    fn as_any(&self) -> &dyn Any;
}

/// A fit under way on a device.
pub trait Fit: Send {
    /// Returns the iterations done.
    fn step(&self) -> u32;

    /// Runs one submit of iterations towards `until` and returns their losses; none when `until` was reached before.
    ///
    /// # Errors
    /// [`crate::error::Error::Diverged`] on a loss that is not finite; device errors.
    fn advance(&mut self, until: u32) -> Result<Vec<StepLoss>>;

    /// Returns the field without its numbers, which are on the device.
    fn outline(&self) -> Arc<dyn Field>;

    /// Returns the parameters of the field on the device, for drawing during the fit.
    fn params(&self) -> Vec<Buffer>;

    /// Returns the field and the state after the iterations done.
    ///
    /// # Errors
    /// [`crate::error::Error::Diverged`] when a number is not finite; device errors.
    fn state(&self) -> Result<SavedFit>;

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when the fit is over; device errors.
    fn profile_step(&mut self) -> Result<Vec<PassTime>>;
}
