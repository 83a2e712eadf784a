//! Some drivers offer cooperative matrices that are slower than f32: both paths are timed once per device, driver and
//! network, and the verdict is kept.

use crate::config::Config;
use crate::error::Result;
use crate::files;
use crate::gpu::capabilities::DeviceInfo;
use crate::gpu::device::Gpu;
use crate::kernels::tuning::{Layers, Tuning};
use crate::scan::dataset::Dataset;
use crate::train::timing::{Length, Pace, Subject};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Milliseconds per iteration of both paths.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// f32 layers.
    pub f32_ms: f64,
    /// Cooperative matrices.
    pub matrices_ms: f64,
}

impl Verdict {
    /// Returns the faster path.
    pub fn layers(&self) -> Layers {
        if self.matrices_ms < self.f32_ms { Layers::Matrices } else { Layers::F32 }
    }

    /// Returns `tuning` on the faster path, with the reason.
    pub fn apply(&self, tuning: Tuning) -> Tuning {
        let text = format!(
            "{} layers: an iteration takes {:.3} ms in f32 and {:.3} ms on matrices, timed once on this device",
            match self.layers() {
                Layers::F32 => "f32",
                Layers::Matrices => "matrix",
            },
            self.f32_ms,
            self.matrices_ms
        );
        tuning.with_layers(self.layers(), text)
    }
}

/// Both paths are timed after the same warm-up: the first must not pay for clocks that rise.
const PACE: Pace = Pace { warm_up_s: 0.5, repeats: 5, length: Length::Seconds(0.05) };

/// Times both paths on the task at hand.
///
/// # Errors
/// Errors of the configuration, the data and the device.
pub fn measure(gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning) -> Result<Verdict> {
    let time = |layers: Layers| -> Result<f64> {
        let path = tuning.clone().with_layers(layers, String::new());
        Ok(Subject::new(gpu, config, dataset, &path, true)?.time(&PACE)?.median())
    };
    Ok(Verdict { f32_ms: time(Layers::F32)?, matrices_ms: time(Layers::Matrices)? })
}

const FILE: &str = "paths.json";

/// Key of the device, driver and network that a verdict holds for.
fn key(info: &DeviceInfo, config: &Config) -> String {
    let Some((settings, network)) = config.fields().and_then(|s| Some((s.clone(), s.network?))) else {
        return format!("{} | {} | {} | no network", info.uuid, info.driver, env!("CARGO_PKG_VERSION"));
    };
    let (rays, samples) = (settings.rays, settings.march.dynamic_samples);
    let networks = if settings.networks.is_some() { "two networks of " } else { "" };
    format!(
        "{} | {} | {} | {networks}{} layers of {}, skip {}, {} bands | {rays} rays of {samples} samples",
        info.uuid,
        info.driver,
        env!("CARGO_PKG_VERSION"),
        network.layers,
        network.width,
        network.skip_layer,
        network.bands
    )
}

fn read(cache: &Path) -> BTreeMap<String, Verdict> {
    // A cache that cannot be read is made anew.
    std::fs::read(cache.join(FILE)).ok().and_then(|text| serde_json::from_slice(&text).ok()).unwrap_or_default()
}

/// The verdict of an earlier [`remember`].
pub fn recall(cache: &Path, info: &DeviceInfo, config: &Config) -> Option<Verdict> {
    read(cache).get(&key(info, config)).copied()
}

/// Keeps a verdict.
///
/// # Errors
/// [`crate::error::Error::Io`] when the directory cannot be written.
pub fn remember(cache: &Path, info: &DeviceInfo, config: &Config, verdict: Verdict) -> Result<()> {
    let mut all = read(cache);
    all.insert(key(info, config), verdict);
    let text = crate::files::pretty_json(&all)?;
    files::create_directory(cache)?;
    Ok(files::write_atomic(&cache.join(FILE), text.as_bytes())?)
}
