//! Selection of the device and of the computation paths by the options.

use crate::args::options::GlobalOptions;
use nertca_vk::config::Config;
use nertca_vk::error::{Error, Result};
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::cache::save_pipeline_cache;
use nertca_vk::kernels::tuning::{Layers, Tuning};
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::train::calibrate;
use std::path::PathBuf;

impl GlobalOptions {
    /// Opens the device selected by the options.
    pub fn open_device(&self) -> Result<Gpu> {
        Ok(Gpu::open(&DeviceOptions {
            select: self.device.clone(),
            validation: self.validate,
            cache_dir: cache_dir(),
            ..DeviceOptions::default()
        })?)
    }

    /// Returns the computation paths for a configuration: those that the options name, or those that an earlier training on
    /// this device found faster, or those suggested for the device.
    pub fn tuning(&self, gpu: &Gpu, config: &Config) -> Tuning {
        let tuning = Tuning::for_device(gpu.info());
        let Some(layers) = self.layers else {
            return match cache_dir().and_then(|cache| calibrate::recall(&cache, gpu.info(), config)) {
                Some(verdict) if Tuning::has_choice(gpu.info()) => verdict.apply(tuning),
                _ => tuning,
            };
        };
        let reason = match layers {
            Layers::F32 => "f32 layers, as requested",
            Layers::Matrices => "matrix layers, as requested: f16 operands, f32 sums",
        };
        tuning.with_layers(layers, reason.into())
    }

    /// Returns the tuning of [`Self::tuning`], after timing both paths of the layers if they have not been timed yet.
    pub fn training_tuning(&self, gpu: &Gpu, config: &Config, dataset: &Dataset) -> Result<Tuning> {
        let tuning = Tuning::for_device(gpu.info());
        let either = self.layers.is_none() && Tuning::has_choice(gpu.info()) && config.has_network();
        let cache = cache_dir().filter(|_| either);
        let Some(cache) = cache.filter(|cache| calibrate::recall(cache, gpu.info(), config).is_none()) else {
            return Ok(self.tuning(gpu, config));
        };
        let verdict = match calibrate::measure(gpu, config, dataset, &tuning) {
            // The driver may offer matrices but reject their kernels. If the cause is different, the f32 path reports it as
            // well.
            Err(error @ (Error::Vulkan { .. } | Error::Config { .. })) => {
                let reason = format!("f32 layers, because layers on matrices fail on this device ({error})");
                return Ok(tuning.with_layers(Layers::F32, reason));
            }
            verdict => verdict?,
        };
        if let Err(error) = calibrate::remember(&cache, gpu.info(), config, verdict) {
            // Without the file, the paths are only measured again.
            tracing::warn!("{error}");
        }
        Ok(verdict.apply(tuning))
    }

    /// Saves the pipeline cache and turns validation messages into a failure.
    pub fn close_device(&self, gpu: &Gpu) -> Result<()> {
        if let Err(error) = save_pipeline_cache(gpu) {
            // Without the cache, the next start only takes longer.
            tracing::warn!("{error}");
        }
        match gpu.validation_messages().len() {
            0 => Ok(()),
            n => Err(nertca_vk::error::Error::Internal(format!(
                "there were {n} Vulkan validation messages, which are printed above"
            ))),
        }
    }
}

/// Returns the user's cache directory (XDG), if there is one.
fn cache_dir() -> Option<PathBuf> {
    let base = std::env::var_os("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .filter(|p| p.is_absolute())
        .or_else(|| std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".cache")))?;
    Some(base.join("nertca-vk"))
}
