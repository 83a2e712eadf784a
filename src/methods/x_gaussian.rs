//! X-Gaussian (Cai et al. 2024), a static baseline of the paper: Gaussians of which nearer ones hide those behind them, fitted to
//! whole normalised images of each phase, or of all.

pub mod data;
pub mod densify;
pub mod particles;
pub mod setup;
pub mod stages;
pub mod start;
pub mod state;
mod tensors;
pub mod trainer;

use crate::config::sections::XSettings;
use crate::config::{Config, Method as Settings, StaticData};
use crate::error::Result;
use crate::fields::scale::FieldVolume;
use crate::fitting::extent::volume_half;
use crate::fitting::fit::{
    Abilities, Fit, FitData, FitField, FitStart, FitState, Method, PlannedFit, SavedAt, SavedFit, SavedState, Use,
    data_as,
};
use crate::fitting::sets::ignored;
use crate::fitting::shown::ShownFit;
use crate::gaussians::blobs::BlobKernels;
use crate::gaussians::pictures::into_buffers;
use crate::gaussians::stages::SplatStage;
use crate::geometry::MM_PER_UNIT;
use crate::gpu::device::Gpu;
use crate::kernels::push;
use crate::kernels::stages::Build;
use crate::kernels::tuning::Tuning;
use crate::model::Model;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use crate::tensors::File;
use data::XData;
use stages::XKernels;
use state::XState;
use std::sync::Arc;
use trainer::XTrainer;

/// The method, for the registry.
pub static METHOD: Method = Method {
    checkpoint_format: crate::gaussians::tensors::FORMAT,
    smaller_steps: state::SMALLER_STEPS,
    boxes_hold_all_rays: false,
    plan,
    read,
    make_pipelines,
    rays_per_iteration: |_| 0,
    lower_rates,
    abilities: Abilities {
        time_gaussians: Some(|data, start| {
            let fit = begin(data_as::<XData>(data)?.clone(), start, &mut Vec::new())?;
            Ok(Box::new(fit))
        }),
        ..Abilities::NONE
    },
};

/// Prepares a fit.
fn plan(config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
    let config = &config.of::<XSettings>()?;
    let volume = FieldVolume { half: volume_half(config.x.half_extent_mm, dataset), attenuation: None };
    let data = data_of(config, dataset, notes)?;
    Ok(PlannedFit::of_images(Scene::of_volume(dataset, volume), data))
}

/// Reads the field and the state of its fit from a checkpoint.
fn read(sections: &serde_json::Value, _: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit> {
    let gaussians = crate::gaussians::tensors::read_section(sections, file, at.n_phases)?;
    let state = tensors::read(file, at.n_phases)?;
    Ok(SavedFit { field: FitField::of_gaussians(gaussians), state: Arc::new(state) })
}

/// Lowers the learning rates by a factor.
fn lower_rates(config: &mut Config, factor: f64) {
    let Settings::XGaussian(XSettings { x }) = &mut config.method else { return };
    let positions = [&mut x.position_rate, &mut x.position_rate_end];
    let others = [&mut x.intensity_rate, &mut x.opacity_rate, &mut x.scale_rate, &mut x.rotation_rate];
    positions.into_iter().chain(others).for_each(|rate| *rate *= factor);
}

/// Builds the pipelines of fits.
fn make_pipelines(gpu: &Gpu, _: &Config, tuning: &Tuning) -> Result<()> {
    XKernels::new(gpu)?;
    // These fits also use the stages that draw pictures.
    Build::default().stage::<push::GaussianProject>(gpu)?;
    SplatStage::<push::GaussianSplat>::new(gpu)?;
    BlobKernels::new(gpu, tuning)?;
    into_buffers(gpu).map(|_| ())
}

/// Prepares X-Gaussian's data, and notes about them for the user.
fn data_of(config: &Config<XSettings>, dataset: &Dataset, notes: &mut Vec<String>) -> Result<XData> {
    let half = volume_half(config.x.half_extent_mm, dataset);
    let data = XData::new(dataset, &config.x, half)?;
    let side_mm = 2.0 * half * MM_PER_UNIT;
    let whose = match config.x.static_data {
        StaticData::PerPhase => "each phase has its own set, fitted to its images (x.static_data = \"per-phase\")",
        StaticData::Pooled => {
            "one set, fitted to the images of all phases, is used for every phase (x.static_data = \"pooled\")"
        }
    };
    notes.push(format!(
        "X-Gaussian, a static method of Gaussians that occlude each other: {whose}. Initial Gaussians fill a cube of \
         {side_mm:.1} mm in a scene of {:.0} mm. Its pictures have no unit, and its opacities are not attenuation",
        data.extent_mm
    ));
    if data.clamped > 0.0 {
        notes.push(format!(
            "{:.1} % of the images' pixels exceed x.clamp = {} and are clamped to it",
            100.0 * data.clamped,
            config.x.clamp
        ));
    }
    notes.extend(ignored(dataset, "X-Gaussian"));
    Ok(data)
}

/// Begins a fit, or goes on where a saved one has ended.
fn begin(data: XData, start: &FitStart<'_>, notes: &mut Vec<String>) -> Result<ShownFit<XTrainer>> {
    let (gpu, config, from) = (start.gpu, &start.config.of()?, start.from);
    let step = from.field_to(Use::Resume).and_then(|field| Some(field.gaussians.as_ref()?.rows().step));
    let trainer = match from.state_as::<XState>().zip(step) {
        Some((state, step)) => XTrainer::with(gpu, data, config, state, step)?,
        None => {
            let (trainer, more) = XTrainer::new(gpu, data, config)?;
            notes.extend(more);
            trainer
        }
    };
    ShownFit::new(trainer)
}

impl FitData for XData {
    fn begin(self: Box<Self>, start: &FitStart<'_>, notes: &mut Vec<String>) -> Result<Box<dyn Fit>> {
        Ok(Box::new(begin(*self, start, notes)?))
    }

    fn set_scene(&mut self, _: &Scene) {}
}

impl FitState for XState {
    fn saved(&self, _: &Model) -> Result<SavedState> {
        Ok(SavedState::of_tensors(tensors::tensors(self)))
    }
}
