//! Gaussians as the dynamic field in front of a static tensor field, the method of the preset `fast`: the Gaussians are fitted first,
//! to what moves in the images, then the static field to what they leave of the images.

pub mod adjust;
pub mod data;
pub mod deformable;
pub mod fit;
mod groups;
pub mod made;
mod memory;
pub mod per_phase;
pub mod remainder;
mod repeated;
pub mod rules;
pub mod seeds;
pub mod setup;
pub mod soft_hull;
pub(crate) mod target_buffers;
pub mod targets;
pub mod trainer;

use crate::config::sections::GaussiansSettings;
use crate::config::{Config, GaussianForm, Method as Settings, OfMethod};
use crate::error::{Error, Result};
use crate::fields::state;
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
use deformable::stages::DeformableKernels;
use fit::GaussianFit;
use rules::Rules;
use trainer::GaussiansFit;

/// The method, for the registry.
pub static METHOD: Method = Method {
    checkpoint_format: FORMAT,
    smaller_steps: AGAINST_DIVERGENCE,
    boxes_hold_all_rays: false,
    plan,
    read,
    make_pipelines,
    rays_per_iteration: |config| config.fields().map_or(0, |settings| settings.rays),
    lower_rates,
    abilities: Abilities {
        adjust_views: Some(adjust::adjust),
        // Sets per phase are fitted with all pixels from the start.
        estimate_memory: Some(|config, dataset, max_buffer| {
            let form = GaussiansSettings::of(&config.method)?.gaussians.form;
            (form != GaussianForm::Phase).then(|| memory::estimate(dataset, max_buffer))
        }),
        repeat_fits: Some(RepeatFits { count, only_one }),
        time_gaussians: Some(|data, start| {
            let targets = data_as::<GaussianData>(data)?.targets.clone();
            Ok(Box::new(GaussianFit::new(start.gpu, targets, &Rules::of(&start.config.of()?), None)?))
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
    let settings = config.fields().ok_or_else(|| Error::Internal("the configuration has no fields".into()))?;
    let mut saved = state::read(sections, &settings, at, file)?;
    saved.field.gaussians = Some(tensors::read_section(sections, file, at.n_phases)?);
    Ok(saved)
}

/// Builds the pipelines of fits.
fn make_pipelines(gpu: &Gpu, config: &Config, tuning: &Tuning) -> Result<()> {
    GaussianKernels::new(gpu)?;
    if config.of::<GaussiansSettings>()?.gaussians.form != GaussianForm::Phase {
        DeformableKernels::new(gpu)?;
    }
    BlobKernels::new(gpu, tuning)?;
    into_buffers(gpu).map(|_| ())
}

/// Lowers the learning rates by a factor. The run that is measured is that of the static field, after an iteration of Gaussians, of which
/// nothing else depends.
fn lower_rates(config: &mut Config, factor: f64) {
    let Settings::DynamicGaussians(own) = &mut config.method else { return };
    own.static_field.lr_end *= factor;
    own.static_field.lr = own.static_field.lr_end;
    (own.gaussians.iterations, own.gaussians.form) = (1, GaussianForm::Phase);
}

/// Returns the number of fits to the images of these data.
fn count(data: &dyn FitData, config: &Config) -> u32 {
    let fits = GaussiansSettings::of(&config.method).map(|settings| settings.gaussians.fits);
    fits.and_then(|fits| Some(data_as::<GaussianData>(data).ok()?.targets.fits(fits).0)).unwrap_or(1)
}

/// Changes settings that leave the number of fits to the data, so that there is a single one.
fn only_one(config: &mut Config) {
    let Settings::DynamicGaussians(own) = &mut config.method else { return };
    if own.gaussians.fits == 0 {
        own.gaussians.fits = 1;
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
