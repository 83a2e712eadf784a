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
pub mod seeds;
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
mod unseen;

use crate::config::method::MethodKind;
use crate::config::sections::Deformable;
use crate::config::{Config, GaussianForm};
use crate::error::Result;
use crate::fields::data::lower_rates;
use crate::fields::state;
use crate::fitting::fit::{
    AdjustTask, AdjustedFit, Fit, FitData, FitStart, MemoryEstimate, Method, Observe, PlannedFit, SavedAt, SavedFit,
    TimedFit,
};
use crate::gaussians::blobs::BlobKernels;
use crate::gaussians::field::AGAINST_DIVERGENCE;
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
use stages::DeformableKernels;
use std::any::Any;
use trainer::GaussiansFit;

/// The method, for the registry.
pub struct DynamicGaussiansMethod;

impl Method for DynamicGaussiansMethod {
    fn kind(&self) -> MethodKind {
        MethodKind::DynamicGaussians
    }

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
        let mut saved = state::read(sections, config, at, file)?;
        saved.field.gaussians = Some(tensors::read_section(sections, file, at.n_phases)?);
        Ok(saved)
    }

    fn memory(&self, config: &Config, dataset: &Dataset, max_buffer: u64) -> Option<MemoryEstimate> {
        // Sets per phase are fitted with all pixels from the start.
        (config.gaussians.form != GaussianForm::Phase).then(|| memory::estimate(dataset, max_buffer))
    }

    fn rays_per_iteration(&self, config: &Config) -> u32 {
        config.train.rays
    }

    /// The run that is measured is that of the static field, after the minimum number of iterations of Gaussians.
    fn lower_rates(&self, config: &mut Config, factor: f64) {
        lower_rates(config, factor);
        config.gaussians.iterations = 1;
        config.deformable = Deformable { warm_iterations: 1, take: 0.0, track_iterations: 0, ..config.deformable };
    }

    fn smaller_steps(&self) -> &'static str {
        AGAINST_DIVERGENCE
    }

    fn make_pipelines(&self, gpu: &Gpu, config: &Config, tuning: &Tuning) -> Result<()> {
        GaussianKernels::new(gpu)?;
        if config.gaussians.form != GaussianForm::Phase {
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
        Ok(Box::new(GaussianFit::new(start.gpu, self.targets.clone(), start.config)?))
    }

    fn hull(&self) -> Option<&Hull> {
        self.fields.hull()
    }

    fn fits(&self, config: &Config) -> u32 {
        self.targets.fits(config.gaussians.fits).0
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
