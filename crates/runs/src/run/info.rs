//! Record of a run's inputs.

use crate::error::Result;
use crate::files;
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Record of a run's inputs: `run.json`.
#[derive(Debug, Clone, Serialize, serde::Deserialize)]
pub struct RunInfo {
    /// Dataset of the training; where its path is not text in UTF-8, the file holds its bytes.
    #[serde(with = "files::path_in_json")]
    pub dataset: PathBuf,
}

/// Largest accepted size of the file.
const MAX_BYTES: u64 = 1 << 20;

impl RunInfo {
    const FILE: &str = "run.json";

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
