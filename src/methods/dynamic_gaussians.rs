//! Gaussians as the dynamic field in front of a static tensor field, the method of the preset `fast`: the Gaussians are fitted first,
//! to what moves in the images, then the static field to what they leave of the images.

pub mod adjust;
pub mod carried;
pub mod catheter;
pub mod coarse;
pub mod data;
pub mod deformable;
pub mod filling;
pub(crate) mod fine;
pub mod fit;
pub mod lengths;
mod likelihood;
mod linked;
mod made;
mod members;
mod memory;
pub mod per_phase;
mod prior;
mod pruning;
pub mod remainder;
mod repeated;
pub mod rules;
pub mod seeds;
#[cfg(feature = "diagnostics")]
pub mod selftest;
pub mod setup;
pub mod shared_images;
pub mod soft_hull;
pub mod stages;
pub mod start;
mod stiffness;
pub(crate) mod target_buffers;
pub mod targets;
#[cfg(test)]
mod test_targets;
pub mod trainer;
pub mod twin;
mod unseen;

use crate::config::sections::GaussiansSettings;
use crate::config::{Config, GaussianForm, Method as Settings, OfMethod};
use crate::error::{Error, Result};
use crate::fields::state;
use crate::fitting::fit::{
    AdjustTask, AdjustedFit, Fit, FitData, FitStart, MemoryEstimate, Method, Observe, PlannedFit, SavedAt, SavedFit,
    TimedFit,
};
use crate::gaussians::blobs::BlobKernels;
use crate::gaussians::field::SMALLER_STEPS;
use crate::gaussians::pictures::into_buffers;
use crate::gaussians::stages::GaussianKernels;
use crate::gaussians::tensors::{self, FORMAT};
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::model::hull::Hull;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use crate::tensors::File;
use data::GaussianData;
use fit::GaussianFit;
use rules::Rules;
use stages::DeformableKernels;
use std::any::Any;
use trainer::GaussiansFit;

/// The method, for the registry.
pub struct DynamicGaussiansMethod;

impl Method for DynamicGaussiansMethod {
    fn checkpoint_format(&self) -> &'static str {
        FORMAT
    }

    fn plan(&self, config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
        let data = GaussianData::new(config, dataset, notes)?;
        Ok(PlannedFit { scene: data.fields.scene.clone(), data: Box::new(data) })
    }

    fn adjust(&self, task: &AdjustTask<'_>, observe: &mut Observe<'_>) -> Result<Option<AdjustedFit>> {
        adjust::adjust(task, observe)
    }

    fn read(&self, sections: &serde_json::Value, config: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit> {
        let settings = config.fields().ok_or_else(|| Error::Internal("the configuration has no fields".into()))?;
        let mut saved = state::read(sections, &settings, at, file)?;
        saved.field.gaussians = Some(tensors::read_section(sections, file, at.n_phases)?);
        Ok(saved)
    }

    fn memory(&self, config: &Config, dataset: &Dataset, max_buffer: u64) -> Option<MemoryEstimate> {
        // Sets per phase are fitted with all pixels from the start.
        let form = GaussiansSettings::of(&config.method)?.gaussians.form;
        (form != GaussianForm::Phase).then(|| memory::estimate(dataset, max_buffer))
    }

    fn rays_per_iteration(&self, config: &Config) -> u32 {
        config.fields().map_or(0, |settings| settings.rays)
    }

    /// The run that is measured is that of the static field, after an iteration of Gaussians, of which nothing else depends.
    fn lower_rates(&self, config: &mut Config, factor: f64) {
        let Settings::DynamicGaussians(own) = &mut config.method else { return };
        own.static_field.lr_end *= factor;
        own.static_field.lr = own.static_field.lr_end;
        (own.gaussians.iterations, own.gaussians.form) = (1, GaussianForm::Phase);
    }

    fn smaller_steps(&self) -> &'static str {
        SMALLER_STEPS
    }

    fn make_pipelines(&self, gpu: &Gpu, config: &Config, tuning: &Tuning) -> Result<()> {
        GaussianKernels::new(gpu)?;
        if config.of::<GaussiansSettings>()?.gaussians.form != GaussianForm::Phase {
            DeformableKernels::new(gpu)?;
        }
        BlobKernels::new(gpu, tuning)?;
        into_buffers(gpu).map(|_| ())
    }
}

impl FitData for GaussianData {
    fn begin(&self, start: &FitStart<'_>, _: &mut Vec<String>) -> Result<Box<dyn Fit>> {
        Ok(Box::new(GaussiansFit::new(self.clone(), start)?))
    }

    fn begin_only(self: Box<Self>, start: &FitStart<'_>, _: &mut Vec<String>) -> Result<Box<dyn Fit>> {
        Ok(Box::new(GaussiansFit::new(*self, start)?))
    }

    fn begin_timed(&self, start: &FitStart<'_>) -> Result<Box<dyn TimedFit>> {
        Ok(Box::new(GaussianFit::new(start.gpu, self.targets.clone(), &Rules::of(&start.config.of()?))?))
    }

    fn hull(&self) -> Option<&Hull> {
        self.fields.hull()
    }

    fn fits(&self, config: &Config) -> u32 {
        GaussiansSettings::of(&config.method).map_or(1, |settings| self.targets.fits(settings.gaussians.fits).0)
    }

    fn set_scene(&mut self, scene: &Scene) {
        self.fields.set_scene(scene);
    }

    fn as_any(&self) -> &dyn Any {
        self
    }

    fn as_any_mut(&mut self) -> &mut dyn Any {
        self
    }
}
