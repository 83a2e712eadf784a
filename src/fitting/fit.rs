//! Interfaces behind which each method stands: its entry in the registry, the data of a fit, the fit, and the state that a checkpoint
//! keeps of it.

use crate::calibrate::adjustment::Adjusted;
use crate::calibrate::correction::Calibration;
use crate::config::Config;
use crate::error::{Error, Result};
use crate::fitting::ledger::Ledger;
use crate::fitting::losses::StepLoss;
use crate::gaussians::field::{GaussianFeed, GaussianField};
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

/// A method of reconstruction, as the registry has it: what others must know of it, what each method does, and what only some can do.
pub struct Method {
    /// Name of the format of the method's checkpoints.
    pub checkpoint_format: &'static str,
    /// Settings that make the method's steps smaller, as advice for a run that diverged.
    pub smaller_steps: &'static str,
    /// Whether the boxes of the fields hold all rays and do not bound the fields, so that they may grow with new images.
    pub boxes_hold_all_rays: bool,
    /// Prepares a fit: chooses the boxes and scales of the fields and collects the data. Remarks for the user are appended to the notes.
    /// Fails with [`Error::Config`] when dataset and configuration do not fit.
    pub plan: fn(&Config, &Dataset, &mut Vec<String>) -> Result<PlannedFit>,
    /// Reads the field and the state of its fit from a checkpoint, whose header has these sections. Fails with [`Error::Data`] naming
    /// what is missing, misshapen or not finite.
    pub read: fn(&serde_json::Value, &Config, SavedAt, &File<'_>) -> Result<SavedFit>,
    /// Builds the pipelines that only this method uses, for the inventory of compiled pipelines.
    pub make_pipelines: fn(&Gpu, &Config, &Tuning) -> Result<()>,
    /// Returns the rays of an iteration; 0 for a method that draws whole images.
    pub rays_per_iteration: fn(&Config) -> u32,
    /// Lowers the learning rates by a factor, for measurements whose field is to stay as it is.
    pub lower_rates: fn(&mut Config, f64),
    /// Abilities that only some methods have.
    pub abilities: Abilities,
}

/// Abilities that only some methods have.
#[derive(Clone, Copy)]
pub struct Abilities {
    /// Adjusts the calibrated geometry of views with the field in the loop; returns none where the data do not allow it. Fails with
    /// errors of the device and of the observer.
    pub adjust_views: Option<AdjustViews>,
    /// Estimates the memory of a run, from the number and the size of its images, on a device whose buffers have at most this many
    /// bytes; returns none for settings without an estimate.
    pub estimate_memory: Option<EstimateMemory>,
    /// Repeats fits to the same data, whose mean is the field.
    pub repeat_fits: Option<RepeatFits>,
    /// Begins a fit from scratch for measurements of its Gaussians.
    pub time_gaussians: Option<TimeGaussians>,
}

/// Function that adjusts the calibrated geometry of views.
pub type AdjustViews = fn(&AdjustTask<'_>, &mut Observe<'_>) -> Result<Option<AdjustedFit>>;
/// Function that estimates the memory of a run.
pub type EstimateMemory = fn(&Config, &Dataset, u64) -> Option<MemoryEstimate>;
/// Function that begins a fit for measurements.
pub type TimeGaussians = fn(&dyn FitData, &FitStart<'_>) -> Result<Box<dyn Measured>>;

impl Abilities {
    /// Returns the abilities of a method that has none.
    pub const NONE: Abilities =
        Abilities { adjust_views: None, estimate_memory: None, repeat_fits: None, time_gaussians: None };
}

/// Ability to repeat fits to the same data, whose mean is the field.
#[derive(Clone, Copy)]
pub struct RepeatFits {
    /// Returns the number of fits to these data.
    pub count: fn(&dyn FitData, &Config) -> u32,
    /// Changes settings that leave the number of fits to the data, so that there is a single one.
    pub only_one: fn(&mut Config),
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
    pub made: Option<MadeFit>,
}

/// Fit that was done before its run begins, of its method's own type.
pub type MadeFit = Arc<dyn Any + Send + Sync>;

/// Receives the share of a work that is done; an error ends the work.
pub type Observe<'a> = dyn FnMut(f64) -> Result<()> + 'a;

/// Fit that a method has prepared.
pub struct PlannedFit {
    /// Scales and boxes of the fields.
    pub scene: Scene,
    /// Motion hull that bounds the dynamic field, if there is one.
    pub hull: Option<Hull>,
    /// Weighted loss of an empty dynamic field, where it is known.
    pub empty_loss: Option<f64>,
    /// Data of the fit.
    pub data: Box<dyn FitData>,
}

impl PlannedFit {
    /// Returns a fit to images, without a hull.
    pub fn of_images(scene: Scene, data: impl FitData) -> PlannedFit {
        PlannedFit { scene, hull: None, empty_loss: None, data: Box::new(data) }
    }
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
    pub gaussians: Option<GaussianField>,
    /// Field that its method draws itself.
    pub own: Option<Arc<dyn Field>>,
}

impl FitField {
    /// Returns a field that consists of Gaussians alone.
    pub fn of_gaussians(gaussians: GaussianField) -> FitField {
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
    /// Form of the Gaussians where the data decided it; none where the configuration states it.
    pub form: Option<&'static str>,
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
pub trait FitState: Any + Debug + Send + Sync {
    /// Returns the parts of a checkpoint: those of the state, and those of the model's field but for Gaussians and hull, which are
    /// written alike for all methods.
    ///
    /// # Errors
    /// [`Error::Internal`] for a model of another method, and for a section that cannot be written as JSON.
    fn saved(&self, model: &Model) -> Result<SavedState>;
}

/// Parts of a checkpoint that hold the state of a fit.
pub struct SavedState {
    /// Tensors of the file.
    pub tensors: Vec<FileTensor>,
    /// Sections of the header, as keys and JSON.
    pub sections: Vec<(&'static str, String)>,
}

impl SavedState {
    /// Returns parts without a section.
    pub fn of_tensors(tensors: Vec<FileTensor>) -> SavedState {
        SavedState { tensors, sections: Vec::new() }
    }
}

/// Use that a fit makes of an earlier field.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Use {
    /// The fit continues a fit to the same data; the result is that of an uninterrupted one.
    Resume,
    /// The fit goes on from a fit to other data, as far as the method can.
    GoOn,
    /// The fit begins from scratch, and the field is shown until there is a better one.
    Show,
}

/// Results of earlier fits with which a fit begins; nothing for one from scratch.
#[derive(Clone, Copy, Default)]
pub struct Start<'a> {
    /// Field of an earlier fit, and its use.
    pub field: Option<(&'a FitField, Use)>,
    /// State of the earlier fit; without it, only Gaussians are gone on from.
    pub state: Option<&'a dyn FitState>,
    /// Fit that is not repeated where it is one of the run's.
    pub made: Option<&'a MadeFit>,
}

impl<'a> Start<'a> {
    /// Returns the start from a saved fit.
    pub fn of(saved: &'a SavedFit, used: Use) -> Start<'a> {
        Start { field: Some((&saved.field, used)), state: Some(&*saved.state), made: None }
    }

    /// Returns the earlier field, if this is its use.
    pub fn field_to(self, wanted: Use) -> Option<&'a FitField> {
        self.field.and_then(|(field, used)| (used == wanted).then_some(field))
    }

    /// Returns the state of the earlier fit as the type of its method.
    pub fn state_as<T: FitState>(self) -> Option<&'a T> {
        let state: &dyn Any = self.state?;
        state.downcast_ref()
    }
}

/// Device, settings and earlier results with which a fit begins.
#[derive(Clone, Copy)]
pub struct FitStart<'a> {
    /// Device of the fit.
    pub gpu: &'a Gpu,
    /// Configuration of the run.
    pub config: &'a Config,
    /// Choices made for the device.
    pub tuning: &'a Tuning,
    /// Earlier results with which the fit begins.
    pub from: Start<'a>,
}

/// Data that a method is fitted to.
pub trait FitData: Any + Send {
    /// Begins the fit to these data. Remarks for the user are appended to `notes`.
    ///
    /// # Errors
    /// [`Error::Config`] for impossible settings, for a saved fit of other sizes and where memory does not suffice; device errors.
    fn begin(self: Box<Self>, start: &FitStart<'_>, notes: &mut Vec<String>) -> Result<Box<dyn Fit>>;

    /// Replaces scales and boxes of the fields, for example by those of a saved run. Data that depend on neither stay as they are.
    fn set_scene(&mut self, scene: &Scene);
}

/// Returns the data of a fit as the type of their method.
///
/// # Errors
/// [`Error::Internal`] for data of another method.
pub fn data_as<T: FitData>(data: &dyn FitData) -> Result<&T> {
    let data: &dyn Any = data;
    data.downcast_ref().ok_or_else(|| Error::Internal("the data of the fit are those of another method".into()))
}

/// Position of a fit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitProgress {
    /// Iterations done.
    pub step: u32,
    /// Iterations handed to the device.
    pub submitted: u32,
    /// Share done of the preparation before the first iteration; none when that has begun.
    pub preparation: Option<f64>,
    /// Whether the field of earlier data is shown, until the fit has a better one.
    pub shows_earlier: bool,
}

impl FitProgress {
    /// Returns the position of a fit whose iterations have begun and of which none is on its way.
    pub fn at(step: u32) -> FitProgress {
        FitProgress { step, submitted: step, preparation: None, shows_earlier: false }
    }
}

/// Outcome of a submit.
#[derive(Debug, Default)]
pub struct Advance {
    /// Losses that became known.
    pub losses: Vec<StepLoss>,
    /// Settings that make steps smaller from now on, where the losses that follow are those of another objective.
    pub smaller_steps: Option<&'static str>,
    /// Findings about the data, as sentences for the user.
    pub findings: Vec<String>,
}

impl Advance {
    /// Returns the outcome of a submit that made losses known.
    pub fn of(losses: Vec<StepLoss>) -> Advance {
        Advance { losses, ..Advance::default() }
    }
}

/// Iterations under way on a device.
pub trait Iterates: Any + Send {
    /// Returns the position of the fit.
    fn progress(&self) -> FitProgress;

    /// Runs one submit of iterations towards `until` and returns what became known. Work may be in flight afterwards unless `until` is
    /// reached. No losses mean that `until` was reached before, or that the first iteration is still being prepared.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite; device errors.
    fn advance(&mut self, until: u32) -> Result<Advance>;
}

/// Fit of a method to the data of a run.
pub trait Fit: Iterates {
    /// Returns the field as it is drawn now; without its numbers where these are on the device.
    fn outline(&self) -> FitField;

    /// Returns the numbers of the field, for drawing during the fit.
    fn feed(&self) -> FieldFeed;

    /// Copies field and state after the iterations submitted so far. Returns at once where the copies are made on the device, and
    /// the fit may go on.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a number is not finite; device errors.
    fn snapshot(&self) -> Result<PendingFit>;

    /// Returns the fit for measurements, where its method has any.
    fn measured(&mut self) -> Option<&mut dyn Measured>;
}

/// Field and state of a fit on their way to the host: waits until the device has come this far. Fails with [`Error::Diverged`] when a
/// number is not finite, and with errors of the device.
pub type PendingFit = Box<dyn FnOnce() -> Result<SavedFit> + Send>;

/// Fit whose iterations are measured.
pub trait Measured: Iterates {
    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// [`Error::Internal`] when the fit is over; device errors.
    fn profile_step(&mut self) -> Result<Vec<PassTime>>;

    /// Returns the work of the last iteration; none for a fit without Gaussians.
    ///
    /// # Errors
    /// Device errors.
    fn work(&self) -> Result<Option<FitWork>> {
        Ok(None)
    }

    /// Returns the number of barriers of an iteration, where it is known.
    fn barriers(&self) -> Option<u32> {
        None
    }

    /// Returns the minimum work of an iteration's stages with `live_samples` live samples; empty where it is not known.
    fn ledger(&self, _live_samples: u64) -> Ledger {
        Ledger::new()
    }
}
