//! A validated study and its runs.

use crate::COMMIT;
use crate::data::DataSet;
use crate::layout::TableLayout;
use crate::published::Published;
use nertca_vk::config::{Config, renamed};
use nertca_vk::error::{Error, Result};
use nertca_vk::fingerprint::Fingerprint;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A study that is ready to run.
#[derive(Debug, Clone)]
pub struct Study {
    /// Title of its tables and its page.
    pub title: String,
    /// Seeds of data and training.
    pub seeds: Vec<u32>,
    /// Data sets, in the order of the file.
    pub data: Vec<DataSet>,
    /// Methods, in the order of the file.
    pub methods: Vec<Method>,
    /// Layout of the result tables.
    pub table: TableLayout,
    /// Published values to put beside our own.
    pub published: Option<Published>,
}

/// A method of a study.
#[derive(Debug, Clone)]
pub struct Method {
    /// Name in the study.
    pub name: String,
    /// Name in tables.
    pub label: String,
    /// Configuration, without the seed.
    pub config: Config,
    /// Configurations for single data sets, by their names in the file, where they differ from `config`.
    pub config_on: BTreeMap<String, Config>,
    /// Number of iterations of the unchanged preset.
    pub preset_iterations: u32,
    /// Name of the method whose published values stand beside this one.
    pub published: Option<String>,
}

/// A run of a study: one method on one data set with one seed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Run {
    /// Name of the run and of its directory: `DATA.METHOD.sSEED`.
    pub id: String,
    /// Index of its data set in the study.
    #[serde(skip)]
    pub data: usize,
    /// Index of its method in the study.
    #[serde(skip)]
    pub method: usize,
    /// Seed of data and training.
    pub seed: u32,
}

/// Fingerprint of a run's data, configuration and program. A result is valid only for the same fingerprint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunFingerprint {
    /// Fingerprint of the data: of their description or of their bytes.
    pub data: String,
    /// Fingerprint of all hyper-parameters, including the seed.
    pub configuration: String,
    /// Commit of the program.
    pub commit: String,
}

impl RunFingerprint {
    /// Tells whether data and configuration are equal; the commit of the program may differ.
    pub fn asks_the_same(&self, other: &RunFingerprint) -> bool {
        (&self.data, &self.configuration) == (&other.data, &other.configuration)
    }
}

impl Study {
    /// All runs, ordered by data set, then by seed, so that runs with the same data follow each other.
    pub fn runs(&self) -> Vec<Run> {
        let mut runs = Vec::new();
        for data in 0..self.data.len() {
            for &seed in &self.seeds {
                runs.extend((0..self.methods.len()).map(|method| self.run_of(data, method, seed)));
            }
        }
        runs
    }

    /// Returns the run of a method on a data set, both given by index, with a seed.
    pub fn run_of(&self, data: usize, method: usize, seed: u32) -> Run {
        Run { id: format!("{}.{}.s{seed}", self.data[data].id, self.methods[method].name), data, method, seed }
    }

    /// Returns the run with a name.
    ///
    /// # Errors
    /// [`Error::Config`] where there is none.
    pub fn run(&self, id: &str) -> Result<Run> {
        let runs = self.runs();
        let example = runs.first().map_or(String::new(), |run| format!("; the first is `{}`", run.id));
        let none = || Error::config("run", id, format!("the study has no such run{example}"));
        runs.iter().find(|run| run.id == id).cloned().ok_or_else(none)
    }

    /// Configuration of a run.
    pub fn config(&self, run: &Run) -> Config {
        let (method, data) = (&self.methods[run.method], &self.data[run.data].name);
        Config { seed: run.seed, ..method.config_on.get(data).unwrap_or(&method.config).clone() }
    }

    /// Fingerprint of a run.
    ///
    /// # Errors
    /// [`Error::Internal`] for a configuration that cannot be written as TOML.
    pub fn fingerprint(&self, run: &Run) -> Result<RunFingerprint> {
        Ok(RunFingerprint {
            data: self.data[run.data].fingerprint(run.seed),
            configuration: Fingerprint::of(as_before(&self.config(run).to_toml()?).as_bytes()).hex(),
            commit: COMMIT.to_owned(),
        })
    }
}
/// Settings, by section, that were added after results were first recorded, with the values that change nothing.
const NEW_AND_AS_BEFORE: [(&str, &str); 6] = [
    ("[gaussians]", "fits = 1"),
    ("[calibrate]", "adjust = \"off\""),
    ("[gaussians]", "without_catheter = false"),
    ("[r2]", "integral = \"affine\""),
    ("[train]", "stop_at_loss_ratio = 0.0"),
    ("[dynamic]", "occlusion_region = \"depth-range\""),
];

/// Removes newer settings from a configuration where they change nothing, and gives renamed settings their earlier names. Results
/// recorded before thus keep their fingerprint.
fn as_before(configuration: &str) -> String {
    let mut section = "";
    let mut kept = String::with_capacity(configuration.len());
    for line in configuration.split_inclusive('\n') {
        let text = line.trim_end();
        if text.starts_with('[') {
            section = text;
        }
        let key = text.split_once(" = ").map_or("", |(key, _)| key);
        if let Some(before) = renamed::earlier(section.trim_matches(['[', ']']), key) {
            kept.push_str(&line.replacen(key, before, 1));
            continue;
        }
        if !NEW_AND_AS_BEFORE.contains(&(section, text)) {
            kept.push_str(line);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use nertca_vk::config::Preset;

    #[test]
    fn newer_settings_count_where_they_change_something() {
        let of = |settings: &[&str]| {
            let settings: Vec<String> = settings.iter().map(|s| (*s).to_owned()).collect();
            Config::load(Some(Preset::R2Gaussian), None, &settings).unwrap().to_toml().unwrap()
        };
        let (affine, exact) = (of(&["r2.integral=affine"]), of(&["r2.integral=exact"]));
        assert_eq!(as_before(&affine).lines().count() + 6, affine.lines().count());
        assert_eq!(as_before(&exact).lines().count() + 5, exact.lines().count());
        // In another section, the same line is another setting.
        let other = "[x]\nintegral = \"affine\"\n";
        assert_eq!(as_before(other), other);
    }
}
