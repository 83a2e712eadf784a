//! A study, checked, and the runs it comes down to.

use crate::config::Config;
use crate::error::{Error, Result};
use crate::fingerprint::Fingerprint;
use crate::study::COMMIT;
use crate::study::data::DataSet;
use crate::study::layout::TableLayout;
use crate::study::published::Published;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// A study that can be run.
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
    /// How results are shown.
    pub table: TableLayout,
    /// Values to put beside ours.
    pub published: Option<Published>,
}

/// A method of a study.
#[derive(Debug, Clone)]
pub struct Method {
    /// Name in the study.
    pub name: String,
    /// Name in tables.
    pub label: String,
    /// Its configuration, but for the seed.
    pub config: Config,
    /// Its configuration on data sets, by their names in the file, where that is another.
    pub config_on: BTreeMap<String, Config>,
    /// Length of the preset's own run.
    pub preset_iterations: u32,
    /// Whose published values stand beside it.
    pub published: Option<String>,
}

/// A run of a study: one method on one data set with one seed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Run {
    /// Its name, and that of its directory: `DATA.METHOD.sSEED`.
    pub id: String,
    /// Place of its data among the study's.
    #[serde(skip)]
    pub data: usize,
    /// Place of its method among the study's.
    #[serde(skip)]
    pub method: usize,
    /// Seed of data and training.
    pub seed: u32,
}

/// What a run is made of. A result counts for exactly this.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct RunFingerprint {
    /// Of the data: what they are made of, or their bytes.
    pub data: String,
    /// Of every hyper-parameter, the seed among them.
    pub configuration: String,
    /// Commit of the program.
    pub commit: String,
}

impl RunFingerprint {
    /// Whether it is the same but, perhaps, for the program.
    pub fn asks_the_same(&self, other: &RunFingerprint) -> bool {
        (&self.data, &self.configuration) == (&other.data, &other.configuration)
    }
}

impl Study {
    /// All runs: data set by data set, in each seed by seed, so that what shares data stands together.
    pub fn runs(&self) -> Vec<Run> {
        let mut runs = Vec::new();
        for data in 0..self.data.len() {
            for &seed in &self.seeds {
                runs.extend((0..self.methods.len()).map(|method| self.run_of(data, method, seed)));
            }
        }
        runs
    }

    /// The run of a method on a data set, by their places, with a seed.
    pub fn run_of(&self, data: usize, method: usize, seed: u32) -> Run {
        Run { id: format!("{}.{}.s{seed}", self.data[data].id, self.methods[method].name), data, method, seed }
    }

    /// The run of a name.
    ///
    /// # Errors
    /// [`Error::Config`] where there is none.
    pub fn run(&self, id: &str) -> Result<Run> {
        let runs = self.runs();
        let example = runs.first().map_or(String::new(), |run| format!("; the first is `{}`", run.id));
        let none = || Error::config("run", id, format!("the study has no such run{example}"));
        runs.iter().find(|run| run.id == id).cloned().ok_or_else(none)
    }

    /// The configuration of a run.
    pub fn config(&self, run: &Run) -> Config {
        let (method, data) = (&self.methods[run.method], &self.data[run.data].name);
        Config { seed: run.seed, ..method.config_on.get(data).unwrap_or(&method.config).clone() }
    }

    /// What a run is made of.
    ///
    /// # Errors
    /// [`Error::Internal`] for a configuration that cannot be written down.
    pub fn fingerprint(&self, run: &Run) -> Result<RunFingerprint> {
        Ok(RunFingerprint {
            data: self.data[run.data].fingerprint(run.seed),
            configuration: Fingerprint::of(as_before(&self.config(run).to_toml()?).as_bytes()).hex(),
            commit: COMMIT.to_owned(),
        })
    }
}
/// Settings, by section, that have come since results are kept, as they are written where they say what was done before.
const NEW_AND_AS_BEFORE: [(&str, &str); 1] = [("[r2]", "integral = \"affine\"")];

/// A configuration as a program wrote it that did not know the newer settings, where they change nothing: results of it are still its
/// own.
fn as_before(configuration: &str) -> String {
    let mut section = "";
    let mut kept = String::with_capacity(configuration.len());
    for line in configuration.split_inclusive('\n') {
        let text = line.trim_end();
        if text.starts_with('[') {
            section = text;
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
    use crate::config::Preset;

    #[test]
    fn newer_settings_count_where_they_change_something() {
        let of = |settings: &[&str]| {
            let settings: Vec<String> = settings.iter().map(|s| (*s).to_owned()).collect();
            Config::load(Some(Preset::R2Gaussian), None, &settings).unwrap().to_toml().unwrap()
        };
        let (affine, exact) = (of(&["r2.integral=affine"]), of(&["r2.integral=exact"]));
        assert_eq!(as_before(&affine).lines().count() + 1, affine.lines().count());
        assert_eq!(as_before(&exact), exact);
        // Of other sections, the same words are something else.
        let other = "[x]\nintegral = \"affine\"\n";
        assert_eq!(as_before(other), other);
    }
}
