//! R2-Gaussian (Zha et al. 2024), a static baseline of the paper: Gaussians with corrected line integrals, fitted to whole images of
//! each phase, or of all.

pub mod data;
pub mod densify;
pub mod fdk;
pub mod parameters;
pub mod particles;
pub mod setup;
pub mod stages;
pub mod start;
pub mod state;
mod tensors;
pub mod trainer;

use crate::config::sections::R2Settings;
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
use crate::geometry::MM_PER_UNIT;
use crate::gpu::device::Gpu;
use crate::kernels::push;
use crate::kernels::stages::Build;
use crate::kernels::tuning::Tuning;
use crate::model::Model;
use crate::model::scene::Scene;
use crate::scan::dataset::Dataset;
use crate::tensors::File;
use data::R2Data;
use stages::R2Kernels;
use state::R2State;
use std::sync::Arc;
use trainer::R2Trainer;

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
            let fit = begin(data_as::<R2Data>(data)?.clone(), start, &mut Vec::new())?;
            Ok(Box::new(fit))
        }),
        ..Abilities::NONE
    },
};

/// Prepares a fit.
fn plan(config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
    let config = &config.of::<R2Settings>()?;
    let volume = FieldVolume { half: volume_half(config.r2.half_extent_mm, dataset), attenuation: None };
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
    let Settings::R2Gaussian(R2Settings { r2 }) = &mut config.method else { return };
    for rate in [&mut r2.position_rate, &mut r2.density_rate, &mut r2.scale_rate, &mut r2.rotation_rate] {
        *rate *= factor;
    }
}

/// Builds the pipelines of fits.
fn make_pipelines(gpu: &Gpu, config: &Config, tuning: &Tuning) -> Result<()> {
    R2Kernels::new(gpu, config.of::<R2Settings>()?.r2.integral)?;
    // A stage of other fits draws the pictures.
    Build::default().stage::<push::GaussianProject>(gpu)?;
    BlobKernels::new(gpu, tuning)?;
    into_buffers(gpu).map(|_| ())
}

/// Prepares R2-Gaussian's data, and notes about them for the user.
fn data_of(config: &Config<R2Settings>, dataset: &Dataset, notes: &mut Vec<String>) -> Result<R2Data> {
    let half = volume_half(config.r2.half_extent_mm, dataset);
    let data = R2Data::new(dataset, &config.r2, half)?;
    let side_mm = 2.0 * half * MM_PER_UNIT;
    notes.push(match config.r2.static_data {
        StaticData::PerPhase => format!(
            "R2-Gaussian, a static method: each phase is reconstructed from its own images, in a cube of {side_mm:.1} mm \
             (r2.static_data = \"per-phase\")"
        ),
        StaticData::Pooled => format!(
            "R2-Gaussian, a static method: one reconstruction from the images of all phases, in a cube of {side_mm:.1} \
             mm, is used for every phase (r2.static_data = \"pooled\")"
        ),
    });
    if config.r2.normalise && dataset.vessel_attenuation.is_none() {
        notes.push(
            "the dataset states no attenuation of vessels: densities are per 100 mm, and R2-Gaussian's fixed density \
             thresholds may not fit them"
                .into(),
        );
    }
    notes.extend(ignored(dataset, "R2-Gaussian"));
    Ok(data)
}

/// Begins a fit, or goes on where a saved one has ended.
fn begin(data: R2Data, start: &FitStart<'_>, notes: &mut Vec<String>) -> Result<ShownFit<R2Trainer>> {
    let (gpu, config, from) = (start.gpu, &start.config.of()?, start.from);
    let step = from.field_to(Use::Resume).and_then(|field| Some(field.gaussians.as_ref()?.rows().step));
    let trainer = match from.state_as::<R2State>().zip(step) {
        Some((state, step)) => R2Trainer::with(gpu, data, config, state, step)?,
        None => {
            let (trainer, more) = R2Trainer::new(gpu, data, config)?;
            notes.extend(more);
            trainer
        }
    };
    ShownFit::new(trainer)
}

impl FitData for R2Data {
    fn begin(self: Box<Self>, start: &FitStart<'_>, notes: &mut Vec<String>) -> Result<Box<dyn Fit>> {
        Ok(Box::new(begin(*self, start, notes)?))
    }

    fn set_scene(&mut self, _: &Scene) {}
}

impl FitState for R2State {
    fn saved(&self, _: &Model) -> Result<SavedState> {
        Ok(SavedState::of_tensors(tensors::tensors(self)))
    }
}
