//! Record of a run's inputs, and of what it took.

use crate::error::Result;
use crate::files;
use crate::gpu::calls::Calls;
use crate::run::events::StageTime;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Record of a run's inputs, and of what it took: `run.json`.
#[derive(Debug, Clone, Serialize, serde::Deserialize)]
pub struct RunInfo {
    /// Dataset of the training; where its path is not text in UTF-8, the file holds its bytes.
    #[serde(with = "files::path_in_json")]
    pub dataset: PathBuf,
    /// Stages of the process that trained last, once it has ended.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub stages: Vec<StageTime>,
    /// Calls of that process to its device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calls: Option<Calls>,
}

/// Largest accepted size of the file.
const MAX_BYTES: u64 = 1 << 20;

impl RunInfo {
    const FILE: &str = "run.json";

    /// Returns the record of a run that begins on a dataset.
    pub fn new(dataset: &Path) -> RunInfo {
        let dataset = dataset.canonicalize().unwrap_or_else(|_| dataset.to_owned());
        RunInfo { dataset, stages: Vec::new(), calls: None }
    }

    /// Writes the record into a run directory.
    ///
    /// # Errors
    /// [`crate::error::Error::Io`].
    pub fn write(&self, run: &Path) -> Result<()> {
        let text = crate::files::pretty_json(&self)?;
        Ok(files::write_atomic(&run.join(Self::FILE), text.as_bytes())?)
    }

    /// Reads the record from a run directory, or from the directory of a checkpoint.
    ///
    /// # Errors
    /// [`crate::error::Error::Io`] or [`crate::error::Error::Data`].
    pub fn read(run: &Path) -> Result<RunInfo> {
        let directory = if run.is_file() { run.parent().unwrap_or(Path::new(".")) } else { run };
        let file = directory.join(Self::FILE);
        Ok(files::read_json(&file, MAX_BYTES)?)
    }
}
