//! Selection of the keys of a configuration: the settings of a preset's method that a user may change, and those that all methods
//! share. All other numbers of a configuration are constants of the program: what a publication fixes, and what was tuned. They are
//! recorded in checkpoints, so that a run continues with the numbers that it began with.

use crate::choice::Choice;
use crate::config::{Config, Preset};
use crate::error::{Error, Result};

/// Tells whether a setting, such as `train.rays`, is a key of a preset: one that all methods share, or one of its method.
fn is_key_of(preset: Preset, key: &str) -> bool {
    let of_method = || Config::preset(preset).method().settings().is_key(preset, key);
    match key.split_once('.') {
        None | Some(("calibrate", "mode")) | Some(("march", "render_samples")) => true,
        Some(("train", name)) if !["rays", "motion_share", "validate_images"].contains(&name) => true,
        Some(_) => of_method(),
    }
}

impl Config {
    /// Tells whether a setting, by its key, is one that a user of this configuration's preset may change.
    pub fn acts(&self, key: &str) -> bool {
        is_key_of(self.preset, key)
    }

    /// Refuses a setting that differs from `before` and is no key of the preset.
    pub(super) fn check_acts(&self, before: &toml::Table, key: &str) -> Result<()> {
        let now = toml::Table::try_from(self).map_err(|e| Error::Internal(e.to_string()))?;
        let value = at(&now, key);
        if self.acts(key) || value == at(before, key) {
            return Ok(());
        }
        let preset = self.preset.name();
        let see = format!("`train --preset {preset} --print-config` prints the settings of this preset");
        let problem = if Preset::ALL.iter().any(|other| is_key_of(*other, key)) {
            format!("has no effect with the preset `{preset}`; {see}")
        } else {
            let constant = at(before, key).map_or(String::new(), ToString::to_string);
            format!("is a constant of the program, {constant} with the preset `{preset}`; {see}")
        };
        Err(Error::config(key, value.map_or(String::new(), ToString::to_string), problem))
    }

    /// Returns the settings that a user may change as TOML.
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
pub(super) fn at<'a>(table: &'a toml::Table, key: &str) -> Option<&'a toml::Value> {
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
            (Preset::R2Gaussian, "sax.lrate=0.5"),
            (Preset::XGaussian, "r2.n_points=3"),
            (Preset::Fast, "dynamic.width=64"),
            (Preset::Paper, "gaussians.count=9"),
            (Preset::NerfCa, "static.grid=12"),
        ] {
            let message = load(preset, setting).unwrap_err().to_string();
            let key = setting.split('=').next().unwrap();
            assert!(message.contains(key) && message.contains("has no effect with the preset"), "{setting}: {message}");
        }
        // A value that changes nothing is no mistake.
        load(Preset::SaxNerf, "loss.normalise=false").unwrap();
    }

    #[test]
    fn constants_are_refused_with_their_value_and_tests_may_change_them() {
        for (preset, setting, value) in
            [(Preset::Fast, "gaussians.cut=3", "3.2"), (Preset::Paper, "static.tv_line=1", "0.001")]
        {
            let message = load(preset, setting).unwrap_err().to_string();
            assert!(message.contains("is a constant of the program") && message.contains(value), "{message}");
            Config::preset(preset).with_constants(&[setting.to_owned()]).unwrap();
        }
    }

    #[test]
    fn a_method_has_at_most_thirty_one_settings_and_all_have_at_most_a_hundred() {
        let mut all = std::collections::BTreeSet::new();
        for preset in Preset::ALL.iter().copied() {
            let printed: toml::Table = Config::preset(preset).acting_toml().unwrap().parse().unwrap();
            // A preset is chosen by --preset.
            let keys: Vec<String> = keys(&printed).into_iter().filter(|key| key != "preset").collect();
            assert!(keys.len() <= 31, "{preset:?}: {} settings {keys:?}", keys.len());
            all.extend(keys);
        }
        assert!(all.len() <= 100, "{} settings", all.len());
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
