//! All hyper-parameters; unknown keys are refused.
//!
//! Precedence: preset < TOML file < single settings `key=value`.

mod acting;
mod checks;
mod dynamic_gaussians;
mod fields;
mod forms;
mod length;
pub mod method;
mod nerf_ca;
mod nert_ca;
mod r2_gaussian;
pub mod renamed;
mod sax_nerf;
mod section;
pub mod sections;
mod x_gaussian;

pub use crate::calibrate::settings::CalibrateMode;
use crate::calibrate::settings::CalibrateSettings;
use crate::choice::Choice;
use crate::error::{Error, Result};
use crate::files;
pub use forms::{
    AdjustMode, Decay, DynamicForm, DynamicTarget, GaussianForm, OcclusionRegion, R2Integral, R2Start, StaticData,
    StaticForm,
};
use method::MethodKind;
use sections::{
    Adam, Calibrate, Deformable, DynamicField, Gaussians, Hull, Loss, March, Networks, Occupancy, R2, Sax, StaticField,
    Train, X,
};
use serde::{Deserialize, Serialize};
use std::path::Path;
use strum::{IntoStaticStr, VariantArray};

/// Largest accepted size of a configuration file, bytes.
const MAX_FILE_BYTES: u64 = 1 << 20;
/// Largest number below which a float represents every whole number: 2^53.
const MAX_WHOLE: f64 = 9_007_199_254_740_992.0;

/// A named set of defaults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Preset {
    /// Moving Gaussians in front of a static tensor field; the default.
    #[default]
    Fast,
    /// The paper's two fields with normalised data, a motion hull and tuned settings.
    FastMlp,
    /// The method as the paper states it.
    Paper,
    /// The method as the authors' public code implements it.
    PublicCode,
    /// NeRF-CA, a baseline of the paper, as its public code implements it: both fields are networks.
    NerfCa,
    /// R2-Gaussian, a static baseline of the paper: Gaussians alone, fitted to each phase separately.
    R2Gaussian,
    /// X-Gaussian, a static baseline of the paper: Gaussians that hide each other, as in Gaussian splatting.
    XGaussian,
    /// SAX-NeRF, a static baseline of the paper: a hash grid and a Lineformer, fitted to each phase separately.
    SaxNerf,
}

/// All settings of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Preset that the defaults came from.
    pub preset: Preset,
    /// Seed of initialisation, ray order and depths.
    pub seed: u32,
    /// The training loop.
    pub train: Train,
    /// Self-calibration of the views; absent from older checkpoints.
    #[serde(default = "nert_ca::uncalibrated")]
    pub calibrate: Calibrate,
    /// Sampling along rays.
    pub march: March,
    /// The static field.
    #[serde(rename = "static")]
    pub static_field: StaticField,
    /// The dynamic field.
    pub dynamic: DynamicField,
    /// Loss terms.
    pub loss: Loss,
    /// Motion hull.
    pub hull: Hull,
    /// Occupancy grid learned during training.
    pub occupancy: Occupancy,
    /// Two networks as the fields; absent from older checkpoints.
    #[serde(default = "nerf_ca::networks")]
    pub networks: Networks,
    /// The optimiser.
    pub adam: Adam,
    /// Gaussians as the dynamic field; absent from older checkpoints.
    #[serde(default = "dynamic_gaussians::gaussians")]
    pub gaussians: Gaussians,
    /// One moving set of Gaussians; absent from older checkpoints.
    #[serde(default = "dynamic_gaussians::deformable", rename = "tree")]
    pub deformable: Deformable,
    /// Gaussians as R2-Gaussian fits them; absent from older checkpoints.
    #[serde(default = "r2_gaussian::r2")]
    pub r2: R2,
    /// Gaussians as X-Gaussian fits them; absent from older checkpoints.
    #[serde(default = "x_gaussian::x")]
    pub x: X,
    /// A hash grid and a Lineformer as SAX-NeRF fits them; absent from older checkpoints.
    #[serde(default = "sax_nerf::sax")]
    pub sax: Sax,
}

impl Config {
    /// Builds a configuration from a preset, an optional TOML file and `key=value` settings.
    ///
    /// # Errors
    /// [`Error::Config`] or [`Error::Io`] naming key or file.
    pub fn load(preset: Option<Preset>, file: Option<&Path>, settings: &[String]) -> Result<Config> {
        let overlay = match file {
            None => toml::Table::new(),
            Some(path) => {
                let text = files::read_text(path, MAX_FILE_BYTES)?;
                text.parse::<toml::Table>()
                    .map_err(|e| Error::config(path.display().to_string(), "TOML", e.message()))?
            }
        };
        let in_file = |error: Error| match (error, file) {
            (Error::Config { field, value, problem }, Some(path)) => {
                Error::Config { field: format!("{}: {field}", path.display()), value, problem }
            }
            (error, _) => error,
        };
        let named = match overlay.get("preset") {
            None => None,
            Some(value) => Some(
                value
                    .clone()
                    .try_into::<Preset>()
                    .map_err(|e| in_file(Error::config("preset", value, e.message().to_owned())))?,
            ),
        };
        let base = Config::preset(preset.or(named).unwrap_or_default());
        base.check_values(&overlay).map_err(in_file)?;
        base.overlaid(overlay, settings, &[])
    }

    /// Returns this configuration with `key=value` settings.
    ///
    /// # Errors
    /// [`Error::Config`] naming the key.
    pub fn with(&self, settings: &[String]) -> Result<Config> {
        self.overlaid(toml::Table::new(), settings, &[])
    }

    /// Returns this configuration with `key=value` settings that may also change constants of the program: for schedules of
    /// another length, and for tests.
    ///
    /// # Errors
    /// [`Error::Config`] naming the key.
    pub fn with_constants(&self, constants: &[String]) -> Result<Config> {
        self.overlaid(toml::Table::new(), &[], constants)
    }

    /// Returns this configuration with `key=value` settings, and with `constants` as in [`Config::with_constants`].
    ///
    /// # Errors
    /// [`Error::Config`] naming the key.
    pub fn with_both(&self, settings: &[String], constants: &[String]) -> Result<Config> {
        self.overlaid(toml::Table::new(), settings, constants)
    }

    /// Checks that each value of a table fits its key by itself, whatever the others are.
    fn check_values(&self, overlay: &toml::Table) -> Result<()> {
        let before = toml::Table::try_from(self).map_err(|e| Error::Internal(e.to_string()))?;
        let mut overlay = overlay.clone();
        renamed::rename(&mut overlay);
        acting::keys(&overlay).iter().filter(|key| *key != "preset").try_for_each(|key| {
            let Some(value) = acting::at(&overlay, key) else { return Ok(()) };
            check_value(&before, key, value)
        })
    }

    /// Overrides this configuration with the table of a file, then with settings and constants; the preset is kept. Constants of
    /// the program are accepted in `constants` alone.
    fn overlaid(&self, overlay: toml::Table, settings: &[String], constants: &[String]) -> Result<Config> {
        let before = toml::Table::try_from(self).map_err(|e| Error::Internal(e.to_string()))?;
        let (mut table, keep) = (before.clone(), before.get("preset").cloned());
        let mut overlay = overlay;
        renamed::rename(&mut overlay);
        // A file with every setting was written by a program; it may also contain settings that do not act.
        let is_whole = overlay.clone().try_into::<Config>().is_ok();
        let mut given = if is_whole { Vec::new() } else { acting::keys(&overlay) };
        merge(&mut table, overlay, "")?;
        for (at, setting) in settings.iter().chain(constants).enumerate() {
            let (key, value) = setting.split_once('=').ok_or_else(|| {
                Error::config("setting", setting, "is not of the form key=value, e.g. train.rays=512")
            })?;
            let key = renamed::current(key.trim());
            let value = parse_value(value.trim());
            check_value(&before, &key, &value)?;
            merge(&mut table, nested(&key, value), "")?;
            if at < settings.len() {
                given.push(key);
            }
        }
        if let Some(preset) = keep {
            table.insert("preset".into(), preset);
        }
        let config: Config = table
            .try_into()
            .map_err(|e: toml::de::Error| Error::config("configuration", "", e.message().to_owned()))?;
        config.check()?;
        given.iter().try_for_each(|key| config.check_acts(&before, key))?;
        Ok(config)
    }

    /// Returns the method that the forms of the fields choose.
    pub fn method(&self) -> MethodKind {
        match self.gaussians.form {
            GaussianForm::R2 => MethodKind::R2Gaussian,
            GaussianForm::X => MethodKind::XGaussian,
            _ if self.dynamic.form == DynamicForm::Lineformer => MethodKind::SaxNerf,
            GaussianForm::None if self.static_field.form == StaticForm::Network => MethodKind::NerfCa,
            GaussianForm::None => MethodKind::NertCa,
            GaussianForm::Auto | GaussianForm::Phase | GaussianForm::Deformable => MethodKind::DynamicGaussians,
        }
    }

    /// Tells whether the dynamic field supports a displacement of the heart in each frame; methods fitted to whole images do
    /// not.
    pub fn follows_breath(&self) -> bool {
        self.method() == MethodKind::DynamicGaussians
    }

    /// Returns the settings of the calibration before the fit.
    pub fn calibration(&self) -> CalibrateSettings {
        CalibrateSettings { mode: self.calibrate.mode, follows_breath: self.follows_breath() }
    }

    /// Checks that the method uses vessels that are known before; `field` and `value` tell where they come from.
    ///
    /// # Errors
    /// [`Error::Config`].
    pub fn takes_prior(&self, field: &str, value: &str) -> Result<()> {
        if self.method() == MethodKind::DynamicGaussians {
            return Ok(());
        }
        let problem = format!("is used by the preset `fast` only, and the preset is `{}`", Choice::name(self.preset));
        Err(Error::config(field, value, problem))
    }

    /// Returns the number of iterations at the start of the run that fit Gaussians; the others fit the static field.
    pub fn gaussian_iterations(&self) -> u32 {
        match self.gaussians.form {
            GaussianForm::None => 0,
            GaussianForm::R2 | GaussianForm::X => self.train.iterations,
            _ => self.gaussians.iterations.min(self.train.iterations),
        }
    }

    /// Returns the configuration as TOML.
    pub fn to_toml(&self) -> Result<String> {
        toml::to_string_pretty(self).map_err(|e| Error::Internal(e.to_string()))
    }
}

/// Reads a value as TOML has it, or a number as people type it (`.003`, `5.`, `007`); all else is a string.
fn parse_value(text: &str) -> toml::Value {
    let toml = format!("v = {text}").parse::<toml::Table>().ok().and_then(|mut t| t.remove("v"));
    toml.or_else(|| number(text)).unwrap_or_else(|| toml::Value::String(text.to_owned()))
}

/// Reads a number that TOML would write in another way.
fn number(text: &str) -> Option<toml::Value> {
    let plain = text.replace('_', "");
    let whole = plain.parse::<i64>().ok().map(toml::Value::Integer);
    let starts_as_number = plain.starts_with(|c: char| c.is_ascii_digit() || "+-.".contains(c));
    whole.or_else(|| plain.parse::<f64>().ok().filter(|_| starts_as_number).map(toml::Value::Float))
}

/// Checks that a value fits a key of a complete configuration.
fn check_value(before: &toml::Table, key: &str, value: &toml::Value) -> Result<()> {
    let mut changed = before.clone();
    merge(&mut changed, nested(key, value.clone()), "")?;
    let read = changed.try_into::<Config>();
    read.map(drop).map_err(|e: toml::de::Error| Error::config(key, value, e.message().to_owned()))
}

fn nested(key: &str, value: toml::Value) -> toml::Table {
    let mut table = toml::Table::new();
    match key.split_once('.') {
        None => table.insert(key.to_owned(), value),
        Some((head, rest)) => table.insert(head.to_owned(), toml::Value::Table(nested(rest, value))),
    };
    table
}

/// Overrides values of `base` with those of `overlay`; keys that `base` lacks are refused.
fn merge(base: &mut toml::Table, overlay: toml::Table, prefix: &str) -> Result<()> {
    for (key, value) in overlay {
        let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
        let known: Vec<String> = base.keys().cloned().collect();
        match (base.get_mut(&key), value) {
            (None, value) => {
                return Err(Error::config(
                    name,
                    value,
                    format!("unknown key; the known keys are: {}", known.join(", ")),
                ));
            }
            (Some(toml::Value::Table(inner)), toml::Value::Table(over)) => merge(inner, over, &name)?,
            (Some(toml::Value::Float(slot)), toml::Value::Integer(i)) => *slot = i as f64,
            (Some(toml::Value::Integer(slot)), toml::Value::Float(x)) if x.fract() == 0.0 && x.abs() <= MAX_WHOLE => {
                *slot = x as i64;
            }
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
    fn more_first_gaussians_than_there_is_room_for_are_refused_however_many() {
        let mut config = Config::preset(Preset::XGaussian);
        (config.x.voxels, config.x.interval) = (2048, 1);
        assert!(config.check().unwrap_err().to_string().contains("x.max_gaussians"));
    }

    #[test]
    fn settings_override_files_override_presets() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("c.toml");
        std::fs::write(&file, "preset = \"paper\"\n[train]\nrays = 100\niterations = 7\n").unwrap();
        let config = Config::load(None, Some(&file), &["train.rays=64".into(), "static.lr=1".into()]).unwrap();
        assert_eq!((config.train.rays, config.train.iterations, config.dynamic.width), (64, 7, 128));
        assert_eq!((config.preset, config.static_field.lr), (Preset::Paper, 1.0));
    }

    #[test]
    fn numbers_are_read_as_people_type_them() {
        let lr = |text: &str| Config::load(None, None, &[format!("static.lr={text}")]).unwrap().static_field.lr;
        for text in ["0.003", ".003", "3e-3", "3E-3", "+.003", "+0.003", "0.003_0", "00.003"] {
            assert_eq!(lr(text), 0.003, "{text}");
        }
        assert_eq!((lr("5"), lr("5."), lr("+5"), lr("1_0")), (5.0, 5.0, 5.0, 10.0));
        let rays = |text: &str| Config::load(None, None, &[format!("train.rays={text}")]).unwrap().train.rays;
        for text in ["1000", "1_000", "+1000", "1e3", "1000.0", "01000"] {
            assert_eq!(rays(text), 1000, "{text}");
        }
    }

    #[test]
    fn what_does_not_fit_names_key_and_file() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("mine.toml");
        for (text, parts) in [
            ("[train]\nrays = -1\n", &["mine.toml", "train.rays = -1", "invalid value"][..]),
            ("[train]\nrays = 0.5\n", &["mine.toml", "train.rays = 0.5", "expected integer"]),
            ("[train]\nray = 5\n", &["mine.toml", "train.ray ", "unknown key"]),
            ("[gaussians]\nform = 'x y'\n", &["mine.toml", "gaussians.form", "unknown variant"]),
            ("preset = 'quick'\n", &["mine.toml", "preset", "quick"]),
        ] {
            std::fs::write(&file, text).unwrap();
            let told = Config::load(None, Some(&file), &[]).unwrap_err().to_string();
            assert!(parts.iter().all(|part| told.contains(part)), "{text}: {told}");
        }
        let told = Config::load(None, None, &["train.rays=-1".into()]).unwrap_err().to_string();
        assert!(told.contains("train.rays = -1"), "{told}");
        std::fs::write(&file, b"\xef\xbb\xbfpreset = 'paper'\n").unwrap();
        assert_eq!(Config::load(None, Some(&file), &[]).unwrap().preset, Preset::Paper);
        assert!(Config::load(None, Some(directory.path()), &[]).unwrap_err().to_string().contains("is a folder"));
    }

    #[test]
    fn bad_settings_name_the_key() {
        for (setting, part) in [
            ("train.rayz=3", "train.rayz"),
            ("train.rays=hello", "train.rays"),
            ("train.rays=0", "train.rays"),
            ("dynamic.width=20", "dynamic.width"),
            ("dynamic.lr=nan", "dynamic.lr"),
            ("gaussians.min_scale=4", "gaussians.min_scale"),
            ("gaussians.bend=nan", "gaussians.bend"),
            ("gaussians.count=0", "gaussians.count"),
            ("tree.track_blur=0", "tree.track_blur"),
            ("train", "setting"),
            ("static.form=network", "gaussians.form"),
            ("march.along_axis=true", "march.along_axis"),
            ("networks.gain=-1", "networks.gain"),
            ("static.form=none", "static.form"),
            ("gaussians.form=r2", "static.form"),
            ("r2.n_points=0", "r2.n_points"),
            ("dynamic.form=lineformer", "static.form"),
            ("sax.num_levels=0", "sax.num_levels"),
        ] {
            let message = Config::load(None, None, &[setting.into()]).unwrap_err().to_string();
            assert!(message.contains(part), "{setting}: {message}");
        }
    }

    #[test]
    fn what_does_not_go_with_two_networks_is_named() {
        for (setting, part) in [
            ("hull.enabled=true", "hull.enabled"),
            ("occupancy.enabled=true", "occupancy.enabled"),
            ("gaussians.form=tree", "gaussians.form"),
            ("loss.dynamic_target=temporal", "loss.dynamic_target"),
            ("loss.normalise=true", "loss.normalise"),
            ("march.fit_static_range=true", "march.fit_static_range"),
            ("dynamic.delay=3", "dynamic.delay"),
            ("dynamic.occlusion=1e-8", "networks.near_integral"),
            ("dynamic.half_extent_mm=20", "dynamic.half_extent_mm"),
            ("dynamic.normalised_shift=-9", "dynamic.normalised_shift"),
            ("march.static_samples=24", "march.static_samples"),
        ] {
            let message = Config::load(Some(Preset::NerfCa), None, &[setting.into()]).unwrap_err().to_string();
            assert!(message.contains(part) && message.contains("static.form"), "{setting}: {message}");
        }
    }

    #[test]
    fn what_does_not_go_with_r2_and_x_is_named() {
        let r2 = [
            ("static.form=tensor", "static.form"),
            ("gaussians.form=phase", "static.form"),
            ("hull.enabled=true", "hull.enabled"),
            ("occupancy.enabled=true", "occupancy.enabled"),
            ("loss.normalise=true", "loss.normalise"),
            ("loss.dynamic_target=temporal", "loss.dynamic_target"),
            ("march.along_axis=true", "march.along_axis"),
            ("r2.tv_vol_size=300", "r2.tv_vol_size"),
            ("r2.scale_min=0.6", "r2.scale_min"),
            ("r2.max_num_gaussians=10", "r2.n_points"),
            ("r2.static_data=both", "both"),
        ];
        let x = [
            ("static.form=tensor", "static.form"),
            ("hull.enabled=true", "X-Gaussian"),
            ("x.interval=300", "x.interval"),
            ("x.max_gaussians=10", "x.max_gaussians"),
            ("x.first_opacity=0.001", "x.first_opacity"),
        ];
        let all = r2.map(|case| (Preset::R2Gaussian, case)).into_iter().chain(x.map(|case| (Preset::XGaussian, case)));
        for (preset, (setting, part)) in all {
            let message = Config::load(Some(preset), None, &[setting.into()]).unwrap_err().to_string();
            assert!(message.contains(part), "{setting}: {message}");
        }
    }

    #[test]
    fn a_printed_configuration_reads_back() {
        for preset in Preset::ALL.iter().copied() {
            let config = Config::preset(preset);
            config.check().unwrap();
            assert_eq!(toml::from_str::<Config>(&config.to_toml().unwrap()).unwrap(), config);
        }
    }

    #[test]
    fn a_configuration_of_before_gaussians_has_none() {
        let config = Config::preset(Preset::FastMlp);
        let mut table = toml::Table::try_from(&config).unwrap();
        assert!(table.remove("gaussians").is_some() && table.remove("tree").is_some());
        assert!(table.remove("networks").is_some() && table.remove("r2").is_some() && table.remove("sax").is_some());
        assert!(table.remove("x").is_some());
        for (section, key) in
            [("static", "form"), ("dynamic", "form"), ("march", "along_axis"), ("adam", "decay_share")]
        {
            assert!(table[section].as_table_mut().unwrap().remove(key).is_some());
        }
        assert_eq!(table.try_into::<Config>().unwrap(), config);
    }
}
