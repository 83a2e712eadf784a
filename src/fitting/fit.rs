//! Fits of methods to a dataset.

use crate::config::Config;
use crate::config::method::MethodKind;
use crate::error::Result;
use crate::fitting::field::Field;
use crate::fitting::losses::StepLoss;
use crate::gaussians::field::{DynamicGaussians, GaussianFeed};
use crate::gaussians::work::GaussianWork;
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::kernels::tuning::Tuning;
use crate::scan::dataset::Dataset;
use crate::tensors::{File, FileTensor};
use std::any::Any;
use std::fmt::Debug;
use std::sync::Arc;

/// A method of reconstruction with settings, data, stages and a field of its own.
pub trait Method: Sync {
    /// Returns the entry of the configuration that chooses this method.
    fn kind(&self) -> MethodKind;

    /// Returns the name of the format of the method's checkpoints.
    fn checkpoint_format(&self) -> &'static str;

    /// Prepares the data of a fit and appends remarks about them to `notes`.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] when dataset and configuration do not fit.
    fn plan(&self, config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<Box<dyn FitData>>;

    /// Returns the volume that the field fills.
    fn volume(&self, config: &Config, dataset: &Dataset) -> FieldVolume;

    /// Reads the field and the state of its fit from a checkpoint, whose header has these `sections`.
    ///
    /// # Errors
    /// [`crate::error::Error::Data`] naming what is missing, misshapen or not finite.
    fn read(&self, sections: &serde_json::Value, config: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit>;

    /// Returns the rays of an iteration; 0 for a method that draws whole images.
    fn rays_per_iteration(&self, config: &Config) -> u32;

    /// Lowers the learning rates by a factor, for measurements whose field is to stay as it is.
    fn lower_rates(&self, config: &mut Config, factor: f64);

    /// Returns the settings that make the method's steps smaller, as advice for a run that diverged.
    fn smaller_steps(&self) -> &'static str;

    /// Builds all pipelines, for the inventory of compiled pipelines.
    ///
    /// # Errors
    /// Device errors.
    fn make_pipelines(&self, gpu: &Gpu, config: &Config, tuning: &Tuning) -> Result<()>;
}

/// Volume that a field fills.
#[derive(Debug, Clone, Copy)]
pub struct FieldVolume {
    /// Half side of a cube around the isocentre, world units.
    pub half: f64,
    /// Attenuation per world unit that is the unit of the field's volumes; none where the images decide.
    pub attenuation: Option<f64>,
}

/// Number of phases of the run and iteration at which a checkpoint was saved.
#[derive(Debug, Clone, Copy)]
pub struct SavedAt {
    /// Cardiac phases.
    pub n_phases: usize,
    /// Iterations done.
    pub step: u32,
}

/// Field that a fit yields.
#[derive(Debug, Clone)]
pub enum FitField {
    /// Gaussians, which are drawn and exported like those of all methods.
    Gaussians(Box<DynamicGaussians>),
    /// Field that its method draws itself.
    Own(Arc<dyn Field>),
}

impl FitField {
    /// Returns the Gaussians, or the field that its method draws; one of the two is `None`.
    pub fn split(self) -> (Option<DynamicGaussians>, Option<Arc<dyn Field>>) {
        match self {
            FitField::Gaussians(gaussians) => (Some(*gaussians), None),
            FitField::Own(field) => (None, Some(field)),
        }
    }
}

/// Numbers of a field during its fit, for those who draw it.
#[derive(Clone)]
pub enum FieldFeed {
    /// Gaussians, on the host.
    Gaussians(GaussianFeed),
    /// Parameters on the device.
    Params(Vec<Buffer>),
}

/// Work of an iteration of Gaussians.
#[derive(Debug, Clone, Copy)]
pub struct FitWork {
    /// Number of Gaussians.
    pub count: u32,
    /// Work of the last iteration.
    pub work: GaussianWork,
}

/// A field, and the state from which its fit is resumed.
#[derive(Debug, Clone)]
pub struct SavedFit {
    /// The field.
    pub field: FitField,
    /// State of the optimiser.
    pub state: Arc<dyn FitState>,
}

/// State of a fit beside its field.
pub trait FitState: Debug + Send + Sync {
    /// Returns the state as tensors of a checkpoint, with those of a field that its method draws itself. `field` is `None` for
    /// Gaussians, whose tensors are written for all methods alike.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] for a field of another method.
    fn tensors(&self, field: Option<&dyn Field>) -> Result<Vec<FileTensor>>;

    /// Returns the state as its own type, for its method.
    fn as_any(&self) -> &dyn Any;
}

/// Data that a method is fitted to.
pub trait FitData: Send {
    /// Begins a fit, or resumes a `saved` fit to the same data. Remarks for the user are appended to `notes`.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] for impossible settings, for a `saved` fit of other sizes and where memory does not suffice;
    /// device errors.
    fn begin(
        &self,
        gpu: &Gpu,
        config: &Config,
        saved: Option<&SavedFit>,
        notes: &mut Vec<String>,
    ) -> Result<Box<dyn Fit>>;

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

    /// Returns the field as it is drawn now; without its numbers where these are on the device.
    fn outline(&self) -> FitField;

    /// Returns the numbers of the field, for drawing during the fit.
    fn feed(&self) -> FieldFeed;

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

    /// Returns the work of the last iteration, for methods whose work depends on the size of their Gaussians.
    ///
    /// # Errors
    /// Device errors.
    fn work(&self) -> Result<Option<FitWork>> {
        Ok(None)
    }
}
