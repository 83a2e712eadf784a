//! The error type of the crate.

use std::path::{Path, PathBuf};

/// Result of every fallible function of this crate.
pub type Result<T> = std::result::Result<T, Error>;

/// Error of this crate: its cause and its place.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A file is malformed.
    #[error("{}: {field}: {problem}", file.display())]
    Data {
        /// The file that holds the fault.
        file: PathBuf,
        /// Field, frame or element inside the file.
        field: String,
        /// The fault, and the expected content.
        problem: String,
    },
    /// The operating system refused a file operation.
    #[error("{}: {action} failed: {source}", path.display())]
    Io {
        /// The attempted action, e.g. `read`.
        action: &'static str,
        /// The path concerned.
        path: PathBuf,
        /// The error that the system returned.
        source: std::io::Error,
    },
    /// An internal invariant was violated, which is a fault of this crate.
    #[error("internal fault: {0}")]
    Internal(String),
}

impl Error {
    /// Returns an [`Error::Data`] for `field` of `file`.
    pub fn data(file: impl AsRef<Path>, field: impl Into<String>, problem: impl Into<String>) -> Self {
        Error::Data { file: file.as_ref().to_path_buf(), field: field.into(), problem: problem.into() }
    }

    /// Returns a function that wraps a system error with the action and the path.
    pub fn io(action: &'static str, path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_path_buf();
        move |source| Error::Io { action, path, source }
    }
}
