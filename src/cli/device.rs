//! The device and the paths through its kernels that the options ask for.

use super::args::Cli;
use nertca_vk::config::Config;
use nertca_vk::error::{Error, Result};
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::{Layers, Tuning};
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::calibrate;
use std::path::PathBuf;

impl Cli {
    /// Opens the device the options ask for.
    pub fn open_device(&self) -> Result<Gpu> {
        Gpu::open(&DeviceOptions {
            select: self.device.clone(),
            validation: self.validate,
            cache_dir: cache_dir(),
            ..DeviceOptions::default()
        })
    }

    /// Paths through the kernels for a configuration: as the options ask, as an earlier training on this device found
    /// faster, or as the device suggests.
    pub fn tuning(&self, gpu: &Gpu, config: &Config) -> Tuning {
        let tuning = Tuning::for_device(gpu.info());
        let Some(layers) = self.layers else {
            return match cache_dir().and_then(|cache| calibrate::recall(&cache, gpu.info(), config)) {
                Some(verdict) if Tuning::has_choice(gpu.info()) => verdict.apply(tuning),
                _ => tuning,
            };
        };
        let reason = match layers {
            Layers::F32 => "f32 layers, as asked",
            Layers::Matrices => "matrix layers, as asked: f16 operands, f32 sums",
        };
        tuning.with_layers(layers, reason.into())
    }

    /// The tuning of [`Cli::tuning`], after timing both paths where that is still to be done.
    pub fn training_tuning(&self, gpu: &Gpu, config: &Config, dataset: &Dataset) -> Result<Tuning> {
        let tuning = Tuning::for_device(gpu.info());
        let either = self.layers.is_none() && Tuning::has_choice(gpu.info()) && config.network_moves();
        let cache = cache_dir().filter(|_| either);
        let Some(cache) = cache.filter(|cache| calibrate::recall(cache, gpu.info(), config).is_none()) else {
            return Ok(self.tuning(gpu, config));
        };
        let verdict = match calibrate::measure(gpu, config, dataset, &tuning) {
            // A driver that offers matrices and does not take their kernels; if it is something else, f32 tells as well.
            Err(error @ (Error::Vulkan { .. } | Error::Config { .. })) => {
                let reason = format!("f32 layers: those on matrices fail on this device ({error})");
                return Ok(tuning.with_layers(Layers::F32, reason));
            }
            verdict => verdict?,
        };
        if let Err(error) = calibrate::remember(&cache, gpu.info(), config, verdict) {
            // It only has to be measured again.
            tracing::warn!("{error}");
        }
        Ok(verdict.apply(tuning))
    }

    /// Saves the pipeline cache and turns validation messages into a failure.
    pub fn close_device(&self, gpu: &Gpu) -> Result<()> {
        if let Err(error) = gpu.save_pipeline_cache() {
            // A missing cache only costs time at the next start.
            tracing::warn!("{error}");
        }
        match gpu.validation_messages().len() {
            0 => Ok(()),
            n => Err(nertca_vk::error::Error::Internal(format!("{n} Vulkan validation messages, printed above"))),
        }
    }
}

/// The user's cache directory (XDG), if there is one.
fn cache_dir() -> Option<PathBuf> {
    let base = std::env::var_os("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .filter(|p| p.is_absolute())
        .or_else(|| std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".cache")))?;
    Some(base.join("nertca-vk"))
}
