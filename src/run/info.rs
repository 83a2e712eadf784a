//! Record of a run's inputs.

use crate::error::{Error, Result};
use crate::files;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Record of a run's inputs: `run.json`.
#[derive(Debug, Clone, Serialize, serde::Deserialize)]
pub struct RunInfo {
    /// Dataset of the training.
    pub dataset: PathBuf,
}

impl RunInfo {
    const FILE: &str = "run.json";

    /// Writes the record into a run directory.
    ///
    /// # Errors
    /// [`Error::Io`].
    pub fn write(&self, run: &Path) -> Result<()> {
        let text = crate::files::pretty_json(&self)?;
        Ok(files::write_atomic(&run.join(Self::FILE), text.as_bytes())?)
    }

    /// Reads the record from a run directory, or from the directory of a checkpoint.
    ///
    /// # Errors
    /// [`Error::Io`] or [`Error::Data`].
    pub fn read(run: &Path) -> Result<RunInfo> {
        let directory = if run.is_file() { run.parent().unwrap_or(Path::new(".")) } else { run };
        let file = directory.join(Self::FILE);
        let text = std::fs::read(&file).map_err(Error::io("read", &file))?;
        serde_json::from_slice(&text).map_err(|e| Error::data(&file, "JSON", e.to_string()))
    }
}
