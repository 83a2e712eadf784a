//! A validated study and its runs.

use crate::COMMIT;
use crate::data::DataSet;
use crate::layout::TableLayout;
use crate::published::Published;
use nertca_vk::config::Config;
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

/// Line of a setting that was added when results had been recorded, and that changes nothing.
const ADDED: &str = "without_rules = []\n";

/// Default treatment of a catheter.
const CATHETER: &str = "catheter = \"auto\"\n";
/// Beginning of the line before which recorded results have their default treatment of a catheter, and what they state there.
const BEFORE_RULES: [&str; 2] = ["without_rules = ", "without_catheter = false\nwithout_rules = "];

/// Writes settings as recorded results state them, so that these keep their fingerprint. `shows_catheter` tells whether the data may show a
/// catheter; both defaults do the same without one.
fn as_before(settings: &str, shows_catheter: bool) -> String {
    let [line, with_catheter] = BEFORE_RULES;
    let is_default = settings.contains(CATHETER) && !shows_catheter;
    let settings =
        if is_default { settings.replace(CATHETER, "").replace(line, with_catheter) } else { settings.into() };
    settings.replace(ADDED, "")
}

/// Fingerprint of a run's data, configuration and program. A result is valid only for the same fingerprint.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunFingerprint {
    /// Fingerprint of the data: of their description or of their bytes.
    pub data: String,
    /// Fingerprint of preset, seed and all settings; constants belong to the program.
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
        let (data, settings) = (&self.data[run.data], self.config(run).acting_toml()?);
        Ok(RunFingerprint {
            data: data.fingerprint(run.seed),
            configuration: Fingerprint::of(as_before(&settings, data.source.may_show_catheter()).as_bytes()).hex(),
            commit: COMMIT.to_owned(),
        })
    }
}
