//! All hyper-parameters; unknown keys are refused.
//!
//! Precedence: preset < TOML file < `--set key=value`.

use crate::error::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// A named set of defaults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// Normalised, hull-gated, tuned; the default.
    #[default]
    Fast,
    /// As the paper states it.
    Paper,
    /// As the authors' public code does it.
    PublicCode,
}

impl Preset {
    /// As typed on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Preset::Fast => "fast",
            Preset::Paper => "paper",
            Preset::PublicCode => "public-code",
        }
    }
}

/// How a learning rate goes from start to end.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Decay {
    /// A straight line over the run.
    Linear,
    /// A constant factor per step.
    Exponential,
}

/// What drives the dynamic field.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum DynamicTarget {
    /// The shared residual of both fields (paper).
    Absolute,
    /// The line integral above the pixel's still background: cancels whatever does not move.
    Temporal,
}

/// Everything that can be set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Where the defaults came from.
    pub preset: Preset,
    /// Seed of initialisation, ray order and depths.
    pub seed: u32,
    /// The loop.
    pub train: Train,
    /// Sampling along rays.
    pub march: March,
    /// The still background.
    #[serde(rename = "static")]
    pub static_field: StaticField,
    /// The moving vessels.
    pub dynamic: DynamicField,
    /// Loss terms.
    pub loss: Loss,
    /// Motion hull.
    pub hull: Hull,
    /// Occupancy learned while training.
    pub occupancy: Occupancy,
    /// The optimiser.
    pub adam: Adam,
}

/// The loop.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Train {
    /// Length of the run; schedules refer to it.
    pub iterations: u32,
    /// Rays of a batch.
    pub rays: u32,
    /// Share of the batch drawn from rays that meet the motion hull.
    pub motion_share: f64,
    /// Samples evaluated at once, at most: bounds device memory, not results. A device may allow fewer.
    pub chunk_samples: u32,
    /// Iterations handed to the device at once.
    pub iterations_per_submit: u32,
    /// Iterations between checkpoints.
    pub checkpoint_every: u32,
    /// Iterations between validations; 0 turns them off.
    pub validate_every: u32,
    /// Validation images used during training; evenly spread over all of them.
    pub validate_images: u32,
}

/// Sampling along rays.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct March {
    /// Depths per ray for the static field.
    pub static_samples: u32,
    /// Depths per ray for the dynamic field.
    pub dynamic_samples: u32,
    /// Depths per ray when rendering.
    pub render_samples: u32,
    /// Draw depths for each ray instead of once per iteration.
    pub per_ray_depths: bool,
    /// Spread the dynamic field's depths over its own box instead of the whole depth range.
    pub fit_dynamic_range: bool,
}

/// The low-rank static field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StaticField {
    /// Cells per axis, D.
    pub grid: u32,
    /// Ranks per mode, R.
    pub ranks: u32,
    /// Half side of its box, mm; 0 = the dataset's depth range.
    pub half_extent_mm: f64,
    /// Standard deviation of the initial planes and lines.
    pub init_std: f64,
    /// Learning rate at the start.
    pub lr: f64,
    /// Learning rate at the end.
    pub lr_end: f64,
    /// How it decays.
    pub decay: Decay,
    /// Weight of total variation, lambda_TV.
    pub tv: f64,
    /// Share of the planes in it.
    pub tv_plane: f64,
    /// Share of the lines in it.
    pub tv_line: f64,
}

/// The dynamic neural field.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DynamicField {
    /// Hidden layers.
    pub layers: u32,
    /// Neurons per hidden layer, a multiple of 16.
    pub width: u32,
    /// Hidden layer (from 1) that sees the encoded input again; 0 = none.
    pub skip_layer: u32,
    /// Numbers of a phase's latent.
    pub latent: u32,
    /// Frequency bands of the encoding.
    pub bands: u32,
    /// Bands open when the field starts.
    pub window_start: f64,
    /// Iterations until all bands are open, counted from the delay.
    pub window_iterations: u32,
    /// Half side of its box, mm; 0 = the field of view.
    pub half_extent_mm: f64,
    /// Encode coordinates relative to the field's box instead of world units.
    pub encode_box: bool,
    /// Iterations before the field starts; the optimiser is re-created then.
    pub delay: u32,
    /// Learning rate at the start.
    pub lr: f64,
    /// Learning rate at the end.
    pub lr_end: f64,
    /// How it decays.
    pub decay: Decay,
    /// Shift inside its softplus when the problem is normalised, at most: deep hulls start lower.
    pub normalised_shift: f64,
    /// Weight of occlusion minimisation, lambda_o.
    pub occlusion: f64,
    /// Share of the depth range, from the source, it covers.
    pub occlusion_share: f64,
}

/// Loss terms.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Loss {
    /// Scale both fields and residuals by the data, so that numbers are near 1.
    pub normalise: bool,
    /// What drives the dynamic field.
    pub dynamic_target: DynamicTarget,
    /// Residual of the dynamic field, as a share of strong temporal change, from which its loss grows linearly with a
    /// temporal target, when the problem is normalised; 0 = squared throughout.
    pub robust: f64,
}

/// Motion hull: where every view shows temporal change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hull {
    /// Restrict the dynamic field to it.
    pub enabled: bool,
    /// Carve each phase from its own images, not only from what moves over the whole beat.
    pub per_phase: bool,
    /// Cells along each side.
    pub resolution: u32,
    /// A pixel moves when its temporal range exceeds what noise gives by this many standard deviations.
    pub noise_sigmas: f64,
    /// ... and this share of the strongest change in its view, with four views or more.
    pub min_share: f64,
    /// The same with fewer views: each carves less, so more has to be asked of it.
    pub min_share_few_views: f64,
    /// Half width of the widest vessel, pixels: structures as thin as that may hide in the still background.
    /// 0 trusts each pixel's minimum over the phases.
    pub vessel_pixels: u32,
    /// Pixels by which moving regions grow.
    pub dilate_pixels: u32,
    /// Larger hulls (share of the box) are not used.
    pub max_share: f64,
}

/// Occupancy learned while training: where the dynamic field is empty, samples are mostly left out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Occupancy {
    /// Heed it.
    pub enabled: bool,
    /// Cells along each side of the dynamic field's box, for each phase.
    pub cells: u32,
    /// Iterations of the dynamic field before it is heeded.
    pub start: u32,
    /// Attenuation up to which a sample is empty, as a share of the dynamic field's scale: a typical vessel's when the
    /// problem is normalised, 0.01 per mm otherwise.
    pub threshold: f64,
}

/// The optimiser.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Adam {
    /// Decay of the first moment.
    pub beta1: f64,
    /// Decay of the second moment.
    pub beta2: f64,
    /// Added to the denominator.
    pub epsilon: f64,
}

impl Config {
    /// Defaults of a preset.
    pub fn preset(preset: Preset) -> Config {
        let paper = Config {
            preset: Preset::Paper,
            seed: 1,
            train: Train {
                iterations: 30_000,
                rays: 2048,
                motion_share: 0.0,
                chunk_samples: 524_288,
                iterations_per_submit: 16,
                checkpoint_every: 1000,
                validate_every: 1000,
                validate_images: 8,
            },
            march: March {
                static_samples: 256,
                dynamic_samples: 256,
                render_samples: 256,
                per_ray_depths: true,
                fit_dynamic_range: false,
            },
            static_field: StaticField {
                grid: 48,
                ranks: 3,
                half_extent_mm: 50.0,
                init_std: 0.01,
                lr: 1e-2,
                lr_end: 1e-3,
                decay: Decay::Linear,
                tv: 1e-2,
                tv_plane: 1e-2,
                tv_line: 1e-3,
            },
            dynamic: DynamicField {
                layers: 4,
                width: 128,
                skip_layer: 0,
                latent: 8,
                bands: 10,
                window_start: 0.0,
                window_iterations: 15_000,
                half_extent_mm: 100.0,
                encode_box: false,
                delay: 1500,
                lr: 1e-1,
                lr_end: 1e-2,
                decay: Decay::Linear,
                normalised_shift: -2.0,
                occlusion: 1e-8,
                occlusion_share: 0.2,
            },
            loss: Loss { normalise: false, dynamic_target: DynamicTarget::Absolute, robust: 0.0 },
            hull: Hull {
                enabled: false,
                per_phase: false,
                resolution: 128,
                noise_sigmas: 6.0,
                min_share: 0.1,
                min_share_few_views: 0.1,
                vessel_pixels: 3,
                dilate_pixels: 1,
                max_share: 0.35,
            },
            occupancy: Occupancy { enabled: false, cells: 64, start: 15_000, threshold: 0.01 },
            adam: Adam { beta1: 0.9, beta2: 0.99, epsilon: 1e-8 },
        };
        match preset {
            Preset::Paper => paper,
            Preset::PublicCode => Config {
                preset,
                march: March { per_ray_depths: false, ..paper.march },
                static_field: StaticField { lr: 2e-2, lr_end: 2e-3, decay: Decay::Exponential, ..paper.static_field },
                dynamic: DynamicField { layers: 5, skip_layer: 4, decay: Decay::Exponential, ..paper.dynamic },
                ..paper
            },
            Preset::Fast => Config {
                preset,
                train: Train {
                    iterations: 1200,
                    rays: 1024,
                    motion_share: 0.85,
                    validate_every: 200,
                    checkpoint_every: 400,
                    ..paper.train
                },
                march: March {
                    static_samples: 32,
                    dynamic_samples: 128,
                    render_samples: 256,
                    per_ray_depths: true,
                    fit_dynamic_range: true,
                },
                static_field: StaticField { half_extent_mm: 0.0, tv: 1e-3, ..paper.static_field },
                dynamic: DynamicField {
                    layers: 4,
                    width: 96,
                    bands: 8,
                    window_start: 4.0,
                    window_iterations: 600,
                    half_extent_mm: 0.0,
                    encode_box: true,
                    delay: 0,
                    lr: 1e-2,
                    lr_end: 3e-4,
                    occlusion: 0.0,
                    ..paper.dynamic
                },
                loss: Loss { normalise: true, dynamic_target: DynamicTarget::Temporal, robust: 0.1 },
                hull: Hull {
                    enabled: true,
                    per_phase: true,
                    resolution: 224,
                    min_share: 0.05,
                    min_share_few_views: 0.08,
                    dilate_pixels: 0,
                    ..paper.hull
                },
                occupancy: Occupancy { enabled: true, start: 256, ..paper.occupancy },
                ..paper
            },
        }
    }

    /// Builds a configuration from a preset, an optional TOML file and `key=value` settings.
    ///
    /// # Errors
    /// [`Error::Config`] or [`Error::Io`] naming key or file.
    pub fn load(preset: Option<Preset>, file: Option<&Path>, settings: &[String]) -> Result<Config> {
        let overlay = match file {
            None => toml::Table::new(),
            Some(path) => {
                let text = std::fs::read_to_string(path).map_err(Error::io("read", path))?;
                text.parse::<toml::Table>()
                    .map_err(|e| Error::config(path.display().to_string(), "TOML", e.message()))?
            }
        };
        let named = match overlay.get("preset") {
            None => None,
            Some(value) => Some(
                value
                    .clone()
                    .try_into::<Preset>()
                    .map_err(|e| Error::config("preset", value, e.message().to_owned()))?,
            ),
        };
        let base = Config::preset(preset.or(named).unwrap_or_default());
        let mut table = toml::Table::try_from(&base).map_err(|e| Error::Internal(e.to_string()))?;
        let keep = table.get("preset").cloned();
        merge(&mut table, overlay, "")?;
        for setting in settings {
            let (key, value) = setting
                .split_once('=')
                .ok_or_else(|| Error::config("--set", setting, "write it as key=value, e.g. train.rays=512"))?;
            merge(&mut table, nested(key.trim(), parse_value(value.trim())), "")?;
        }
        if let Some(preset) = keep {
            table.insert("preset".into(), preset);
        }
        let config: Config = table.try_into().map_err(|e: toml::de::Error| {
            Error::config("configuration", "", format!("{} (see --print-config)", e.message()))
        })?;
        config.check()?;
        Ok(config)
    }

    /// The configuration as TOML.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(self).map_err(|e| Error::Internal(e.to_string()))
    }

    /// Refuses values no run could use.
    ///
    /// # Errors
    /// [`Error::Config`] naming the key.
    pub fn check(&self) -> Result<()> {
        let between = |field: &str, value: f64, low: f64, high: f64| {
            if value >= low && value <= high {
                Ok(())
            } else {
                Err(Error::config(field, value, format!("{low} to {high} is accepted")))
            }
        };
        let (t, m, s, d) = (&self.train, &self.march, &self.static_field, &self.dynamic);
        for (field, value, low, high) in [
            ("train.iterations", f64::from(t.iterations), 1.0, 1e6),
            ("train.rays", f64::from(t.rays), 1.0, 65_535.0),
            ("train.motion_share", t.motion_share, 0.0, 1.0),
            ("train.chunk_samples", f64::from(t.chunk_samples), 1024.0, 1_048_576.0),
            ("train.iterations_per_submit", f64::from(t.iterations_per_submit), 1.0, 256.0),
            ("train.checkpoint_every", f64::from(t.checkpoint_every), 1.0, 1e6),
            ("march.static_samples", f64::from(m.static_samples), 2.0, 4096.0),
            ("march.dynamic_samples", f64::from(m.dynamic_samples), 2.0, 4096.0),
            ("march.render_samples", f64::from(m.render_samples), 2.0, 4096.0),
            ("static.grid", f64::from(s.grid), 2.0, 512.0),
            ("static.ranks", f64::from(s.ranks), 1.0, 64.0),
            ("static.half_extent_mm", s.half_extent_mm, 0.0, 1e5),
            ("static.init_std", s.init_std, 0.0, 10.0),
            ("static.lr", s.lr, 0.0, 100.0),
            ("static.lr_end", s.lr_end, 0.0, 100.0),
            ("static.tv", s.tv, 0.0, 1e6),
            ("dynamic.layers", f64::from(d.layers), 1.0, 16.0),
            ("dynamic.width", f64::from(d.width), 16.0, 1024.0),
            ("dynamic.skip_layer", f64::from(d.skip_layer), 0.0, f64::from(d.layers)),
            ("dynamic.latent", f64::from(d.latent), 1.0, 64.0),
            ("dynamic.bands", f64::from(d.bands), 1.0, 16.0),
            ("dynamic.window_start", d.window_start, 0.0, f64::from(d.bands)),
            ("dynamic.half_extent_mm", d.half_extent_mm, 0.0, 1e5),
            ("dynamic.lr", d.lr, 0.0, 100.0),
            ("dynamic.lr_end", d.lr_end, 0.0, 100.0),
            ("dynamic.normalised_shift", d.normalised_shift, -20.0, 20.0),
            ("dynamic.occlusion", d.occlusion, 0.0, 1e6),
            ("dynamic.occlusion_share", d.occlusion_share, 0.0, 1.0),
            ("loss.robust", self.loss.robust, 0.0, 1e3),
            ("hull.resolution", f64::from(self.hull.resolution), 8.0, 512.0),
            ("hull.noise_sigmas", self.hull.noise_sigmas, 0.0, 1e3),
            ("hull.min_share", self.hull.min_share, 0.0, 1.0),
            ("hull.min_share_few_views", self.hull.min_share_few_views, 0.0, 1.0),
            ("hull.max_share", self.hull.max_share, 0.0, 1.0),
            ("hull.dilate_pixels", f64::from(self.hull.dilate_pixels), 0.0, 64.0),
            ("hull.vessel_pixels", f64::from(self.hull.vessel_pixels), 0.0, 1024.0),
            ("occupancy.cells", f64::from(self.occupancy.cells), 2.0, 256.0),
            ("occupancy.start", f64::from(self.occupancy.start), 0.0, 1e6),
            ("occupancy.threshold", self.occupancy.threshold, 0.0, 1.0),
            ("adam.beta1", self.adam.beta1, 0.0, 0.999_999),
            ("adam.beta2", self.adam.beta2, 0.0, 0.999_999),
            ("adam.epsilon", self.adam.epsilon, 1e-30, 1.0),
        ] {
            between(field, value, low, high)?;
        }
        if d.width % 16 != 0 {
            return Err(Error::config("dynamic.width", d.width, "a multiple of 16 is needed"));
        }
        if d.latent % 4 != 0 {
            return Err(Error::config("dynamic.latent", d.latent, "a multiple of 4 is needed"));
        }
        if d.skip_layer == 1 {
            return Err(Error::config(
                "dynamic.skip_layer",
                1,
                "the first layer sees the input anyway; 0 or 2.. is accepted",
            ));
        }
        if m.static_samples.max(m.dynamic_samples).max(m.render_samples) > t.chunk_samples {
            return Err(Error::config(
                "train.chunk_samples",
                t.chunk_samples,
                "at least the samples of one ray are needed",
            ));
        }
        if u64::from(t.iterations) * u64::from(t.rays) > u64::from(u32::MAX) {
            return Err(Error::config("train.iterations", t.iterations, "iterations x rays must stay below 2^32"));
        }
        Ok(())
    }
}

fn parse_value(text: &str) -> toml::Value {
    // A bare word is a string; anything TOML understands is taken as that.
    format!("v = {text}")
        .parse::<toml::Table>()
        .ok()
        .and_then(|mut t| t.remove("v"))
        .unwrap_or_else(|| toml::Value::String(text.to_owned()))
}

fn nested(key: &str, value: toml::Value) -> toml::Table {
    let mut table = toml::Table::new();
    match key.split_once('.') {
        None => table.insert(key.to_owned(), value),
        Some((head, rest)) => table.insert(head.to_owned(), toml::Value::Table(nested(rest, value))),
    };
    table
}

/// Lays `overlay` over `base`; keys that `base` lacks are refused.
fn merge(base: &mut toml::Table, overlay: toml::Table, prefix: &str) -> Result<()> {
    for (key, value) in overlay {
        let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        let known: Vec<String> = base.keys().cloned().collect();
        match (base.get_mut(&key), value) {
            (None, value) => {
                return Err(Error::config(name, value, format!("unknown key; known here: {}", known.join(", "))));
            }
            (Some(toml::Value::Table(inner)), toml::Value::Table(over)) => merge(inner, over, &name)?,
            (Some(toml::Value::Float(slot)), toml::Value::Integer(i)) => *slot = i as f64,
            (Some(slot), value) if slot.type_str() == value.type_str() => *slot = value,
            (Some(slot), value) => {
                return Err(Error::config(name, value, format!("expected {}", slot.type_str())));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_override_files_override_presets() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("c.toml");
        std::fs::write(&file, "preset = \"paper\"\n[train]\nrays = 100\niterations = 7\n").unwrap();
        let config = Config::load(None, Some(&file), &["train.rays=64".into(), "adam.epsilon=1".into()]).unwrap();
        assert_eq!((config.train.rays, config.train.iterations, config.dynamic.width), (64, 7, 128));
        assert_eq!((config.preset, config.adam.epsilon), (Preset::Paper, 1.0));
    }

    #[test]
    fn bad_settings_name_the_key() {
        for (setting, part) in [
            ("train.rayz=3", "train.rayz"),
            ("train.rays=hello", "train.rays"),
            ("train.rays=0", "train.rays"),
            ("dynamic.width=20", "dynamic.width"),
            ("dynamic.lr=nan", "dynamic.lr"),
            ("train", "--set"),
        ] {
            let message = Config::load(None, None, &[setting.into()]).unwrap_err().to_string();
            assert!(message.contains(part), "{setting}: {message}");
        }
    }

    #[test]
    fn a_printed_configuration_reads_back() {
        for preset in [Preset::Fast, Preset::Paper, Preset::PublicCode] {
            let config = Config::preset(preset);
            config.check().unwrap();
            assert_eq!(toml::from_str::<Config>(&config.to_toml().unwrap()).unwrap(), config);
        }
    }
}
