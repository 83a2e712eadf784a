//! Selection of the settings that act in a configuration: those of its method, and those that all methods share.

use crate::config::{Config, GaussianForm, StaticForm};
use crate::error::{Error, Result};

/// Kinds of methods that read different settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// A static tensor field and a dynamic network.
    Fields,
    /// Two networks.
    Networks,
    /// A static tensor field behind Gaussians.
    Gaussians,
    R2,
    X,
    Sax,
}

impl Kind {
    fn of(config: &Config) -> Kind {
        match config.gaussians.form {
            GaussianForm::R2 => Kind::R2,
            GaussianForm::X => Kind::X,
            _ if config.is_sax() => Kind::Sax,
            GaussianForm::None if config.static_field.form == StaticForm::Network => Kind::Networks,
            GaussianForm::None => Kind::Fields,
            _ => Kind::Gaussians,
        }
    }

    fn name(self) -> &'static str {
        match self {
            Kind::Fields => "a tensor field and a network",
            Kind::Networks => "two networks (static.form = \"network\")",
            Kind::Gaussians => "Gaussians, then a tensor field (gaussians.form)",
            Kind::R2 => "R2-Gaussian",
            Kind::X => "X-Gaussian",
            Kind::Sax => "SAX-NeRF",
        }
    }

    /// Tells whether the method is fitted to whole images by itself, without a static field.
    fn is_alone(self) -> bool {
        matches!(self, Kind::R2 | Kind::X | Kind::Sax)
    }
}

/// Tells whether a setting acts, for settings that do not choose the method.
fn acts(kind: Kind, section: &str, name: &str) -> bool {
    match (section, name) {
        ("train", "rays" | "motion_share") => !kind.is_alone(),
        ("march", "static_samples") => matches!(kind, Kind::Fields | Kind::Gaussians),
        ("march", "dynamic_samples") => matches!(kind, Kind::Fields | Kind::Networks),
        ("march", "render_samples") => true,
        ("march", _) => !kind.is_alone(),
        ("static", "lr" | "lr_end" | "decay") => !kind.is_alone(),
        ("static", _) => matches!(kind, Kind::Fields | Kind::Gaussians),
        ("dynamic", "half_extent_mm") => matches!(kind, Kind::Fields | Kind::Gaussians),
        ("dynamic", _) => matches!(kind, Kind::Fields | Kind::Networks),
        ("loss", _) => !kind.is_alone(),
        ("hull", "enabled" | "resolution" | "max_share") => kind == Kind::Fields,
        ("hull", _) => !kind.is_alone(),
        ("occupancy", _) => kind == Kind::Fields,
        ("networks", _) => kind == Kind::Networks,
        ("adam", "decay_share") => !kind.is_alone(),
        ("gaussians", _) => kind == Kind::Gaussians,
        ("tree", _) => kind == Kind::Gaussians,
        ("r2", _) => kind == Kind::R2,
        ("x", _) => kind == Kind::X,
        ("sax", _) => kind == Kind::Sax,
        _ => true,
    }
}

/// Settings that studies scale with the length of a run for every method, so that kept results state them.
const SCALED_FOR_ALL: [&str; 3] = ["dynamic.delay", "dynamic.window_iterations", "occupancy.start"];

impl Config {
    /// Tells whether a setting, by its key, acts in this configuration.
    pub fn acts(&self, key: &str) -> bool {
        match key.split_once('.') {
            // The form of a field chooses the method.
            None | Some((_, "form")) => true,
            Some((section, name)) => acts(Kind::of(self), section, name),
        }
    }

    /// Refuses a setting that differs from `before` and does not act.
    pub(super) fn check_acts(&self, before: &toml::Table, key: &str) -> Result<()> {
        let now = toml::Table::try_from(self).map_err(|e| Error::Internal(e.to_string()))?;
        let value = at(&now, key);
        if self.acts(key) || SCALED_FOR_ALL.contains(&key) || value == at(before, key) {
            return Ok(());
        }
        let method = Kind::of(self).name();
        let problem =
            format!("has no effect: the method is {method}; `train --print-config` prints the settings that act");
        Err(Error::config(key, value.map_or(String::new(), ToString::to_string), problem))
    }

    /// Returns the settings that act as TOML.
    ///
    /// # Errors
    /// [`Error::Internal`] when they cannot be written as TOML.
    pub fn acting_toml(&self) -> Result<String> {
        let internal = |e: toml::ser::Error| Error::Internal(e.to_string());
        let mut table = toml::Table::try_from(self).map_err(internal)?;
        for (section, value) in &mut table {
            if let toml::Value::Table(settings) = value {
                settings.retain(|name, _| self.acts(&format!("{section}.{name}")));
            }
        }
        table.retain(|_, value| value.as_table().is_none_or(|settings| !settings.is_empty()));
        toml::to_string_pretty(&table).map_err(internal)
    }
}

/// Returns the value at a key such as `train.rays`.
fn at<'a>(table: &'a toml::Table, key: &str) -> Option<&'a toml::Value> {
    match key.split_once('.') {
        None => table.get(key),
        Some((section, rest)) => at(table.get(section)?.as_table()?, rest),
    }
}

/// Returns the keys of all values of a table.
pub(super) fn keys(table: &toml::Table) -> Vec<String> {
    let below = |(key, value): (&String, &toml::Value)| match value.as_table() {
        Some(inner) => keys(inner).into_iter().map(|name| format!("{key}.{name}")).collect(),
        None => vec![key.clone()],
    };
    table.iter().flat_map(below).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::choice::Choice;
    use crate::config::Preset;

    fn load(preset: Preset, setting: &str) -> Result<Config> {
        Config::load(Some(preset), None, &[setting.to_owned()])
    }

    #[test]
    fn settings_of_other_methods_are_refused_with_the_reason() {
        for (preset, setting) in [
            (Preset::SaxNerf, "dynamic.lr=0.5"),
            (Preset::SaxNerf, "train.rays=7"),
            (Preset::R2Gaussian, "sax.rate=0.5"),
            (Preset::XGaussian, "hull.noise_sigmas=3"),
            (Preset::Fast, "dynamic.width=64"),
            (Preset::Fast, "occupancy.cells=32"),
            (Preset::Paper, "gaussians.count=9"),
            (Preset::NerfCa, "static.grid=12"),
        ] {
            let message = load(preset, setting).unwrap_err().to_string();
            let key = setting.split('=').next().unwrap();
            assert!(message.contains(key) && message.contains("has no effect"), "{setting}: {message}");
        }
        // A value that changes nothing is no mistake, and a form chooses the method.
        load(Preset::SaxNerf, "loss.normalise=false").unwrap();
        let settings = ["gaussians.form=none", "dynamic.width=64"].map(String::from);
        Config::load(Some(Preset::Fast), None, &settings).unwrap();
    }

    #[test]
    fn a_whole_file_is_taken_as_it_is_and_a_part_is_checked() {
        let directory = tempfile::tempdir().unwrap();
        let file = directory.path().join("config.toml");
        let mut config = Config::preset(Preset::SaxNerf);
        // A program with other defaults may have written such a file.
        config.dynamic.lr = 0.123;
        std::fs::write(&file, config.to_toml().unwrap()).unwrap();
        assert_eq!(Config::load(None, Some(&file), &[]).unwrap(), config);
        std::fs::write(&file, "preset = \"sax-nerf\"\n[dynamic]\nlr = 0.123\n").unwrap();
        assert!(Config::load(None, Some(&file), &[]).unwrap_err().to_string().contains("dynamic.lr"));
    }

    #[test]
    fn printed_settings_are_those_that_act_and_read_back() {
        for preset in Preset::ALL.iter().copied() {
            let config = Config::preset(preset);
            let text = config.acting_toml().unwrap();
            let printed: toml::Table = text.parse().unwrap();
            assert!(keys(&printed).iter().all(|key| config.acts(key)), "{preset:?}");
            let directory = tempfile::tempdir().unwrap();
            let file = directory.path().join("config.toml");
            std::fs::write(&file, text).unwrap();
            assert_eq!(Config::load(None, Some(&file), &[]).unwrap(), config, "{preset:?}");
        }
        let printed = |preset| Config::preset(preset).acting_toml().unwrap();
        assert!(!printed(Preset::SaxNerf).contains("[dynamic]\nlayers") && printed(Preset::SaxNerf).contains("[sax]"));
        assert!(printed(Preset::Paper).contains("[dynamic]") && !printed(Preset::Paper).contains("[sax]"));
    }
}
