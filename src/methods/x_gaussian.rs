//! X-Gaussian (Cai et al. 2024), a static baseline of the paper: Gaussians of which nearer ones hide those behind them, fitted to
//! whole normalised images of each phase, or of all.

pub mod data;
pub mod densify;
pub mod particles;
#[cfg(feature = "diagnostics")]
pub mod selftest;
pub mod setup;
pub mod stages;
pub mod start;
pub mod state;
mod tensors;
pub mod trainer;
pub mod twin;

use crate::config::sections::XSettings;
use crate::config::{Config, Method as Settings, StaticData};
use crate::error::Result;
use crate::fields::scale::FieldVolume;
use crate::fitting::extent::volume_half;
use crate::fitting::fit::{Fit, FitData, FitField, FitStart, FitState, Method, PlannedFit, SavedAt, SavedFit};
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
use crate::tensors::{File, FileTensor};
use data::XData;
use stages::XKernels;
use state::XState;
use std::any::Any;
use std::sync::Arc;
use trainer::XTrainer;

/// The method, for the registry.
pub struct XGaussian;

impl Method for XGaussian {
    fn checkpoint_format(&self) -> &'static str {
        crate::gaussians::tensors::FORMAT
    }

    fn plan(&self, config: &Config, dataset: &Dataset, notes: &mut Vec<String>) -> Result<PlannedFit> {
        let config = &config.of::<XSettings>()?;
        let volume = FieldVolume { half: volume_half(config.x.half_extent_mm, dataset), attenuation: None };
        let data = Box::new(data_of(config, dataset, notes)?);
        Ok(PlannedFit { scene: Scene::of_volume(dataset, volume), data })
    }

    fn read(&self, sections: &serde_json::Value, _: &Config, at: SavedAt, file: &File<'_>) -> Result<SavedFit> {
        let gaussians = crate::gaussians::tensors::read_section(sections, file, at.n_phases)?;
        let state = tensors::read(file, at.n_phases)?;
        Ok(SavedFit { field: FitField::of_gaussians(gaussians), state: Arc::new(state) })
    }

    fn rays_per_iteration(&self, _: &Config) -> u32 {
        0
    }

    fn lower_rates(&self, config: &mut Config, factor: f64) {
        let Settings::XGaussian(XSettings { x }) = &mut config.method else { return };
        let positions = [&mut x.position_rate, &mut x.position_rate_end];
        let others = [&mut x.intensity_rate, &mut x.opacity_rate, &mut x.scale_rate, &mut x.rotation_rate];
        positions.into_iter().chain(others).for_each(|rate| *rate *= factor);
    }

    fn smaller_steps(&self) -> &'static str {
        state::SMALLER_STEPS
    }

    fn make_pipelines(&self, gpu: &Gpu, _: &Config, tuning: &Tuning) -> Result<()> {
        XKernels::new(gpu)?;
        // These fits also use the stages that draw pictures.
        Build::default().stage::<push::GaussianProject>(gpu)?;
        SplatStage::<push::GaussianSplat>::new(gpu)?;
        BlobKernels::new(gpu, tuning)?;
        into_buffers(gpu).map(|_| ())
    }
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

impl FitData for XData {
    fn begin(&self, start: &FitStart<'_>, notes: &mut Vec<String>) -> Result<Box<dyn Fit>> {
        let (gpu, config) = (start.gpu, &start.config.of()?);
        let own = |saved: &SavedFit| -> Option<(XState, u32)> {
            let field = saved.field.gaussians.as_ref()?;
            Some((saved.state.as_any().downcast_ref::<XState>()?.clone(), field.rows().step))
        };
        let trainer = match start.from.resumed().and_then(own) {
            Some((state, step)) => XTrainer::with(gpu, self.clone(), config, &state, step)?,
            None => {
                let (trainer, more) = XTrainer::new(gpu, self.clone(), config)?;
                notes.extend(more);
                trainer
            }
        };
        Ok(Box::new(ShownFit::new(trainer)?))
    }

    fn as_any(&self) -> &dyn Any {
        self
    }

    fn as_any_mut(&mut self) -> &mut dyn Any {
        self
    }
}

impl FitState for XState {
    fn tensors(&self, _: &Model) -> Result<Vec<FileTensor>> {
        Ok(tensors::tensors(self))
    }

    fn as_any(&self) -> &dyn Any {
        self
    }
}
