//! Gaussians as the dynamic field in front of a static tensor field, the method of the preset `fast`: the Gaussians are fitted first,
//! to what moves in the images, then the static field to what they leave of the images.

pub mod adjust;
pub mod carried;
pub mod catheter;
pub mod coarse;
mod conversions;
pub mod data;
pub mod deformable;
pub mod filling;
pub(crate) mod fine;
pub mod fit;
mod groups;
pub mod lengths;
mod likelihood;
mod linked;
pub mod made;
mod mean;
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
use crate::fields::{data as data_of_fields, state};
use crate::fitting::fit::{
    Abilities, Fit, FitData, FitStart, Method, PlannedFit, RepeatFits, SavedAt, SavedFit, data_as,
};
use crate::gaussians::blobs::BlobKernels;
use crate::gaussians::field::AGAINST_DIVERGENCE;
use crate::gaussians::pictures::into_buffers;
use crate::gaussians::stages::GaussianKernels;
use crate::gaussians::tensors::{self, FORMAT};
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use crate::tensors::File;
use data::GaussianData;
use fit::GaussianFit;
use stages::DeformableKernels;
use trainer::GaussiansFit;

/// The method, for the registry.
pub static METHOD: Method = Method {
    kind: MethodKind::DynamicGaussians,
    checkpoint_format: FORMAT,
    smaller_steps: AGAINST_DIVERGENCE,
    boxes_hold_all_rays: false,
    plan,
    read,
    make_pipelines,
    rays_per_iteration: |config| config.train.rays,
    lower_rates,
    abilities: Abilities {
        adjust_views: Some(adjust::adjust),
        // Sets per phase are fitted with all pixels from the start.
        estimate_memory: Some(|config, dataset, max_buffer| {
            (config.gaussians.form != GaussianForm::Phase).then(|| memory::estimate(dataset, max_buffer))
        }),
        repeat_fits: Some(RepeatFits { count, only_one }),
        time_gaussians: Some(|data, start| {
            let targets = data_as::<GaussianData>(data)?.targets.clone();
            Ok(Box::new(GaussianFit::new(start.gpu, targets, start.config, None)?))
        }),
    },
};

/// Prepares a fit.
fn plan(config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
    let data = GaussianData::new(config, dataset, notes)?;
    let (scene, hull) = (data.fields.scene.clone(), data.fields.hull.clone());
    Ok(PlannedFit { scene, hull, empty_loss: None, data: Box::new(data) })
}

/// Reads the fields and the state of their fit from a checkpoint.
fn read(sections: &serde_json::Value, config: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit> {
    let mut saved = state::read(sections, config, at, file)?;
    saved.field.gaussians = Some(tensors::read_section(sections, file, at.n_phases)?);
    Ok(saved)
}

/// Builds the pipelines of fits.
fn make_pipelines(gpu: &Gpu, config: &Config, tuning: &Tuning) -> Result<()> {
    GaussianKernels::new(gpu)?;
    if config.gaussians.form != GaussianForm::Phase {
        DeformableKernels::new(gpu)?;
    }
    BlobKernels::new(gpu, tuning)?;
    into_buffers(gpu).map(|_| ())
}

/// Lowers the learning rates by a factor. The run that is measured is that of the static field, after the minimum number of iterations of
/// Gaussians.
fn lower_rates(config: &mut Config, factor: f64) {
    data_of_fields::lower_rates(config, factor);
    config.gaussians.iterations = 1;
    config.deformable = Deformable { warm_iterations: 1, take: 0.0, track_iterations: 0, ..config.deformable };
}

/// Returns the number of fits to the images of these data.
fn count(data: &dyn FitData, config: &Config) -> u32 {
    data_as::<GaussianData>(data).map_or(1, |data| data.targets.fits(config.gaussians.fits).0)
}

/// Changes settings that leave the number of fits to the data, so that there is a single one.
fn only_one(config: &mut Config) {
    if config.gaussians.fits == 0 {
        config.gaussians.fits = 1;
    }
}

impl FitData for GaussianData {
    fn begin(self: Box<Self>, start: &FitStart<'_>, _: &mut Vec<String>) -> Result<Box<dyn Fit>> {
        Ok(Box::new(GaussiansFit::new(*self, start)?))
    }

    fn set_scene(&mut self, scene: &Scene) {
        self.fields.set_scene(scene);
    }
}
