//! Traits behind which each method stands: its entry in the registry, the data of a fit, the fit, and the state that a checkpoint
//! keeps of it.

use crate::calibrate::adjustment::Adjusted;
use crate::calibrate::correction::Calibration;
use crate::config::Config;
use crate::error::{Error, Result};
use crate::fitting::ledger::Ledger;
use crate::fitting::losses::StepLoss;
use crate::gaussians::field::{DynamicGaussians, GaussianFeed};
use crate::gaussians::work::GaussianWork;
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::kernels::tuning::Tuning;
use crate::model::Model;
use crate::model::field::Field;
use crate::model::hull::Hull;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use crate::tensors::{File, FileTensor};
use std::any::Any;
use std::fmt::Debug;
use std::sync::Arc;

/// A method of reconstruction with settings, data, stages and a field of its own.
pub trait Method: Sync {
    /// Returns the name of the format of the method's checkpoints.
    fn checkpoint_format(&self) -> &'static str;

    /// Prepares a fit: chooses the boxes and scales of the fields and collects the data. Remarks for the user are appended to
    /// `notes`.
    ///
    /// # Errors
    /// [`Error::Config`] when dataset and configuration do not fit.
    fn plan(&self, config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit>;

    /// Reads the field and the state of its fit from a checkpoint, whose header has these `sections`.
    ///
    /// # Errors
    /// [`Error::Data`] naming what is missing, misshapen or not finite.
    fn read(&self, sections: &serde_json::Value, config: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit>;

    /// Adjusts the calibrated geometry of views with the field in the loop; `None` where the method or the data do not allow it.
    ///
    /// # Errors
    /// Device errors, and errors of `observe`.
    fn adjust(&self, _task: &AdjustTask<'_>, _observe: &mut Observe<'_>) -> Result<Option<AdjustedFit>> {
        Ok(None)
    }

    /// Estimates the memory of a run, from the number and the size of its images, on a device whose buffers have at most `max_buffer`
    /// bytes; none where the method has no estimate.
    fn memory(&self, _config: &Config, _dataset: &Dataset, _max_buffer: u64) -> Option<MemoryEstimate> {
        None
    }

    /// Returns the rays of an iteration; 0 for a method that draws whole images.
    fn rays_per_iteration(&self, config: &Config) -> u32;

    /// Lowers the learning rates by a factor, for measurements whose field is to stay as it is.
    fn lower_rates(&self, config: &mut Config, factor: f64);

    /// Returns the settings that make the method's steps smaller, as advice for a run that diverged.
    fn smaller_steps(&self) -> &'static str;

    /// Builds the pipelines that only this method uses, for the inventory of compiled pipelines.
    ///
    /// # Errors
    /// Device errors.
    fn make_pipelines(&self, gpu: &Gpu, config: &Config, tuning: &Tuning) -> Result<()>;

    /// Tells whether the boxes of the fields hold all rays and do not bound the fields, so that they may grow with new images.
    fn boxes_hold_all_rays(&self) -> bool {
        false
    }
}

/// Estimate of the largest memory of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryEstimate {
    /// Memory of the host, bytes.
    pub host_bytes: u64,
    /// Memory of the device, bytes.
    pub device_bytes: u64,
    /// Both at once where the memory of the device is that of the host, bytes; less than the sum, because they are largest at
    /// different times.
    pub together_bytes: u64,
}

/// Views whose calibrated geometry is to be adjusted.
#[derive(Clone, Copy)]
pub struct AdjustTask<'a> {
    /// Device of the fits.
    pub gpu: &'a Gpu,
    /// Configuration of the run.
    pub config: &'a Config,
    /// Dataset with the geometry as stated.
    pub dataset: &'a Dataset,
    /// Calibration of its views.
    pub calibration: &'a Calibration,
}

/// Outcome of an adjustment.
#[derive(Debug, Clone)]
pub struct AdjustedFit {
    /// Poses after it, and its record.
    pub adjusted: Adjusted,
    /// Fit to the views as they are after the adjustment; none where it was made with coarser images.
    pub made: Option<MadeGaussians>,
}

/// A fit of Gaussians that is done before its run begins.
#[derive(Debug, Clone)]
pub struct MadeGaussians {
    /// The field after all iterations.
    pub gaussians: DynamicGaussians,
    /// Loss of each iteration.
    pub losses: Vec<f64>,
    /// Findings about the data, for the user.
    pub findings: Vec<String>,
    /// Fingerprint of the data and the settings of the fit.
    pub fingerprint: String,
}

/// Gaussians that were fitted to the images of a run before it begins.
#[derive(Debug, Clone, Copy, Default)]
pub struct PreparedGaussians<'a> {
    /// Fit that is not repeated where it is one of the run's.
    pub made: Option<&'a MadeGaussians>,
    /// Field that is shown until the run has a better one.
    pub shown: Option<&'a DynamicGaussians>,
}

/// Receives the share of a work that is done; an error ends the work.
pub type Observe<'a> = dyn FnMut(f64) -> Result<()> + 'a;

/// Fit that a method has prepared.
pub struct PlannedFit {
    /// Scales and boxes of the fields.
    pub scene: Scene,
    /// Data of the fit.
    pub data: Box<dyn FitData>,
}

/// Number of phases of the run and iteration at which a checkpoint was saved.
#[derive(Debug, Clone, Copy)]
pub struct SavedAt {
    /// Cardiac phases.
    pub n_phases: usize,
    /// Iterations done.
    pub step: u32,
}

/// Field that a fit yields. A method has parameters, Gaussians, both (Gaussians in front of a static field) or a field of its own.
#[derive(Debug, Clone, Default)]
pub struct FitField {
    /// Parameters of the fields that rays are marched through, padded as [`crate::model::params::ParamMap`] says; empty where there
    /// are none, or where they are on the device.
    pub params: Vec<f32>,
    /// Motion hull that bounds the dynamic field, if there is one.
    pub hull: Option<Hull>,
    /// Gaussians, which are drawn and exported alike for all methods.
    pub gaussians: Option<DynamicGaussians>,
    /// Field that its method draws itself.
    pub own: Option<Arc<dyn Field>>,
}

impl FitField {
    /// Returns a field that consists of Gaussians alone.
    pub fn of_gaussians(gaussians: DynamicGaussians) -> FitField {
        FitField { gaussians: Some(gaussians), ..FitField::default() }
    }

    /// Returns a field that its method draws itself.
    pub fn of_own(field: Arc<dyn Field>) -> FitField {
        FitField { own: Some(field), ..FitField::default() }
    }
}

/// Numbers of a field during its fit, for those who draw it.
#[derive(Clone, Default)]
pub struct FieldFeed {
    /// Parameters of the fields that rays are marched through, on the device.
    pub params: Option<Buffer>,
    /// Iteration up to which `params` do not change, because another part of the field is fitted first.
    pub params_fixed_until: u32,
    /// Gaussians, on the host.
    pub gaussians: Option<GaussianFeed>,
    /// Parameters on the device of a field that its method draws itself.
    pub own: Vec<Buffer>,
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
    /// Returns the tensors of a checkpoint: those of the state, and those of the model's field but for Gaussians and hull, which are
    /// written alike for all methods.
    ///
    /// # Errors
    /// [`Error::Internal`] for a model of another method.
    fn tensors(&self, model: &Model) -> Result<Vec<FileTensor>>;

    /// Returns the sections of a checkpoint's header that the state needs, as keys and JSON.
    ///
    /// # Errors
    /// [`Error::Internal`] when a section cannot be written as JSON.
    fn sections(&self) -> Result<Vec<(&'static str, String)>> {
        Ok(Vec::new())
    }

    /// Returns the state as its own type, for its method.
    fn as_any(&self) -> &dyn Any;
}

/// State from which a fit begins.
#[derive(Debug, Clone, Copy)]
pub enum Beginning<'a> {
    /// The fit begins from scratch.
    Scratch,
    /// The fit begins from scratch, with Gaussians that were fitted before.
    Prepared(PreparedGaussians<'a>),
    /// The fit continues a fit to the same data; the result is that of an uninterrupted one.
    Resumed(&'a SavedFit),
    /// The fit goes on from a fit to other data, as far as the method can.
    CarriedOn(&'a SavedFit),
    /// Gaussians may go on from those of a fit to other data; all else begins from scratch.
    AfterGaussians(&'a DynamicGaussians),
}

impl<'a> Beginning<'a> {
    /// Returns the fit to the same data, if that is where the fit begins.
    pub fn resumed(self) -> Option<&'a SavedFit> {
        match self {
            Beginning::Resumed(saved) => Some(saved),
            _ => None,
        }
    }
}

/// Device, settings and state with which a fit begins.
#[derive(Clone, Copy)]
pub struct FitStart<'a> {
    /// Device of the fit.
    pub gpu: &'a Gpu,
    /// Configuration of the run.
    pub config: &'a Config,
    /// Choices made for the device.
    pub tuning: &'a Tuning,
    /// State from which the fit begins.
    pub from: Beginning<'a>,
}

/// Data that a method is fitted to.
pub trait FitData: Send {
    /// Begins a fit. Remarks for the user are appended to `notes`.
    ///
    /// # Errors
    /// [`Error::Config`] for impossible settings, for a saved fit of other sizes and where memory does not suffice; device errors.
    fn begin(&self, start: &FitStart<'_>, notes: &mut Vec<String>) -> Result<Box<dyn Fit>>;

    /// Begins the only fit to these data, as [`FitData::begin`] does, and takes over their memory where the method can.
    ///
    /// # Errors
    /// Errors of [`FitData::begin`].
    fn begin_only(self: Box<Self>, start: &FitStart<'_>, notes: &mut Vec<String>) -> Result<Box<dyn Fit>> {
        self.begin(start, notes)
    }

    /// Begins a fit from scratch for measurements of its Gaussians.
    ///
    /// # Errors
    /// Errors of [`FitData::begin`]; [`Error::Config`] for a method without Gaussians.
    fn begin_timed(&self, start: &FitStart<'_>) -> Result<Box<dyn TimedFit>> {
        Ok(Box::new(self.begin(start, &mut Vec::new())?))
    }

    /// Returns the motion hull that bounds the dynamic field, if there is one.
    fn hull(&self) -> Option<&Hull> {
        None
    }

    /// Returns the number of fits whose mean the field of a configuration is.
    fn fits(&self, _config: &Config) -> u32 {
        1
    }

    /// Returns the weighted loss of an empty dynamic field, where it is known.
    fn empty_loss(&self) -> Option<f64> {
        None
    }

    /// Replaces scales and boxes of the fields, for example by those of a saved run.
    fn set_scene(&mut self, _scene: &Scene) {}

    /// Returns the data as their own type, for their method.
    fn as_any(&self) -> &dyn Any;

    /// Returns the data as their own type, to change them.
    fn as_any_mut(&mut self) -> &mut dyn Any;
}

/// A fit under way on a device.
pub trait Fit: Send {
    /// Returns the iterations done.
    fn step(&self) -> u32;

    /// Returns the iterations handed to the device.
    fn submitted(&self) -> u32 {
        self.step()
    }

    /// Returns the share done of the preparation before the first iteration; none when that has begun.
    fn preparation(&self) -> Option<f64> {
        None
    }

    /// Tells whether the field of earlier data is shown, until the fit has a better one.
    fn shows_earlier(&self) -> bool {
        false
    }

    /// Runs one submit of iterations towards `until` and returns the losses that became known. Work may be in flight afterwards
    /// unless `until` is reached. No losses mean that `until` was reached before, or that the first iteration is still being
    /// prepared.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite; device errors.
    fn advance(&mut self, until: u32) -> Result<Vec<StepLoss>>;

    /// Returns, once, the settings that make steps smaller from now on, when the losses that follow are those of another objective.
    fn new_objective(&mut self) -> Option<&'static str> {
        None
    }

    /// Returns findings about the data since the last call, as sentences for the user.
    fn take_findings(&mut self) -> Vec<String> {
        Vec::new()
    }

    /// Returns the field as it is drawn now; without its numbers where these are on the device.
    fn outline(&self) -> FitField;

    /// Returns the numbers of the field, for drawing during the fit.
    fn feed(&self) -> FieldFeed;

    /// Copies field and state after the iterations submitted so far. Returns at once where the copies are made on the device, and
    /// the fit may go on.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a number is not finite; device errors.
    fn snapshot(&self) -> Result<Box<dyn PendingFit>>;

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// [`Error::Internal`] when the fit is over; device errors.
    fn profile_step(&mut self) -> Result<Vec<PassTime>>;

    /// Returns the work of the last iteration, for methods whose work depends on the size of their Gaussians.
    ///
    /// # Errors
    /// Device errors.
    fn work(&self) -> Result<Option<FitWork>> {
        Ok(None)
    }

    /// Returns the choices made for the device, where the fit made more of them than were given.
    fn tuning(&self) -> Option<&Tuning> {
        None
    }

    /// Returns the number of barriers of an iteration, where it is known.
    fn barriers(&self) -> Option<u32> {
        None
    }

    /// Returns the minimum work of an iteration's stages with `live_samples` live samples; empty where it is not known.
    fn ledger(&self, _live_samples: u64) -> Ledger {
        Ledger::new()
    }

    /// Returns the fit as its own type, for tests and measurements.
    fn as_any(&self) -> &dyn Any;
}

/// Field and state of a fit on their way to the host.
pub trait PendingFit: Send {
    /// Waits until the device has come this far.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a number is not finite; device errors.
    fn wait(self: Box<Self>) -> Result<SavedFit>;
}

impl PendingFit for SavedFit {
    fn wait(self: Box<Self>) -> Result<SavedFit> {
        Ok(*self)
    }
}

/// A fit of Gaussians whose iterations are timed.
pub trait TimedFit {
    /// Returns the form of the Gaussians where the data decided it; none where the configuration states it.
    fn form(&self) -> Option<&'static str> {
        None
    }

    /// Returns the iterations done.
    fn step(&self) -> u32;

    /// Tells whether the first iteration can begin.
    fn is_prepared(&self) -> bool;

    /// Runs one submit and returns the number of iterations that it did.
    ///
    /// # Errors
    /// Errors of [`Fit::advance`].
    fn advance(&mut self, until: u32) -> Result<usize>;

    /// Returns the number of Gaussians and the work of the last iteration.
    ///
    /// # Errors
    /// [`Error::Internal`] for a fit without Gaussians; device errors.
    fn work(&self) -> Result<FitWork>;

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// Errors of [`Fit::profile_step`].
    fn profile_step(&mut self) -> Result<Vec<PassTime>>;
}

impl TimedFit for Box<dyn Fit> {
    fn step(&self) -> u32 {
        self.as_ref().step()
    }

    fn is_prepared(&self) -> bool {
        self.preparation().is_none()
    }

    fn advance(&mut self, until: u32) -> Result<usize> {
        self.as_mut().advance(until).map(|losses| losses.len())
    }

    fn work(&self) -> Result<FitWork> {
        self.as_ref().work()?.ok_or_else(|| Error::Internal("the fit has no Gaussians".into()))
    }

    fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        self.as_mut().profile_step()
    }
}
