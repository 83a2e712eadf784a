//! The error type that all crates of the project share, with one variant per case that a caller can handle.

use nertca_vk_formats as formats;
#[cfg(feature = "gpu")]
use nertca_vk_gpu as gpu;
use std::path::{Path, PathBuf};

/// Result of every fallible function.
pub type Result<T> = std::result::Result<T, Error>;

/// Settings that reduce the memory of most runs; see [`Error::OutOfMemory`].
pub const SMALLER_BATCHES: &str = "a lower train.chunk_samples or train.rays";

/// Error of the project: its cause, its place, and advice where there is any.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Error {
    /// A hyper-parameter or an option is not usable.
    #[error("configuration: {field} = {value}: {problem}")]
    Config {
        /// Name of the key, as written in a TOML file.
        field: String,
        /// The given value.
        value: String,
        /// The reason of the refusal, and the accepted values.
        problem: String,
    },
    /// The configuration cannot be used with the images of a dataset, though it could be with more or other images.
    #[error("configuration: {field} = {value}: {problem}")]
    Unmet {
        /// Name of the key, as written in a TOML file; `dataset` where no key concerns it.
        field: String,
        /// The given value.
        value: String,
        /// The reason of the refusal, and the accepted images.
        problem: String,
    },
    /// An input file is malformed.
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
    /// No suitable Vulkan device was found.
    #[error("no usable Vulkan device: {0}")]
    NoDevice(String),
    /// A Vulkan call failed.
    #[cfg(feature = "gpu")]
    #[error("Vulkan: {call} failed for {object}: {code}")]
    Vulkan {
        /// Name of the Vulkan entry point.
        call: &'static str,
        /// Debug name of the object or pass.
        object: String,
        /// The code the driver returned.
        code: ash::vk::Result,
    },
    /// The device was lost.
    #[error(
        "the Vulkan device was lost during {pass}. The driver may have reset it after a time limit: \
         try a smaller train.iterations_per_submit, another device, or a newer driver. \
         The last checkpoint is intact: training can be resumed from it"
    )]
    DeviceLost {
        /// The submit that was in flight.
        pass: String,
    },
    /// Memory ran out.
    #[error("out of memory: {object} needs {bytes} bytes ({detail}). Try {instead}, or another device")]
    OutOfMemory {
        /// Debug name of the buffer.
        object: String,
        /// Requested size.
        bytes: u64,
        /// The allocator's message.
        detail: String,
        /// Whether it may succeed later, because only other programs hold the memory and no limit is exceeded.
        may_pass: bool,
        /// Alternative that needs less memory.
        instead: &'static str,
    },
    /// The optimisation produced a value that is not finite, or a loss at which the configuration ends a run.
    #[error(
        "training diverged at iteration {step}: {quantity} = {value}. The last good checkpoint is kept. Try {advice}"
    )]
    Diverged {
        /// Iteration at which the divergence was detected.
        step: u64,
        /// Name of the diverged quantity.
        quantity: &'static str,
        /// Its value.
        value: f64,
        /// Settings of the method that make its steps smaller.
        advice: &'static str,
    },
    /// The request cannot be served while another operation is in progress.
    #[error("busy: {0}")]
    Busy(String),
    /// The request needs a result that is not available yet.
    #[error("not ready: {0}")]
    NotReady(String),
    /// The user asked to stop; state was saved.
    #[error("interrupted")]
    Interrupted,
    /// An internal invariant was violated, which is a fault of this program.
    #[error("internal fault: {0}. Please report it")]
    Internal(String),
}

impl Error {
    /// Returns an [`Error::Data`] for `field` of `file`.
    pub fn data(file: impl AsRef<Path>, field: impl Into<String>, problem: impl Into<String>) -> Self {
        Error::Data { file: file.as_ref().to_path_buf(), field: field.into(), problem: problem.into() }
    }

    /// Returns an [`Error::Unmet`] for one key.
    pub fn unmet(field: impl Into<String>, value: impl ToString, problem: impl Into<String>) -> Self {
        Error::Unmet { field: field.into(), value: value.to_string(), problem: problem.into() }
    }

    /// Returns an [`Error::Config`] for one key.
    pub fn config(field: impl Into<String>, value: impl ToString, problem: impl Into<String>) -> Self {
        Error::Config { field: field.into(), value: value.to_string(), problem: problem.into() }
    }

    /// Returns a function that wraps a system error with the action and the path.
    pub fn io(action: &'static str, path: impl AsRef<Path>) -> impl FnOnce(std::io::Error) -> Self {
        let path = path.as_ref().to_path_buf();
        move |source| Error::Io { action, path, source }
    }
}

impl From<formats::error::Error> for Error {
    fn from(error: formats::error::Error) -> Error {
        use formats::error::Error as Files;
        match error {
            Files::Data { file, field, problem } => Error::Data { file, field, problem },
            Files::Io { action, path, source } => Error::Io { action, path, source },
            Files::Internal(fault) => Error::Internal(fault),
            other => Error::Internal(other.to_string()),
        }
    }
}

/// Adds what can be changed in this program to the errors of Vulkan compute.
#[cfg(feature = "gpu")]
impl From<gpu::error::Error> for Error {
    fn from(error: gpu::error::Error) -> Error {
        use gpu::error::Error as Gpu;
        match error {
            Gpu::NoDevice(why) => Error::NoDevice(why),
            Gpu::Vulkan { call, object, code } => Error::Vulkan { call, object, code },
            Gpu::DeviceLost { pass } => Error::DeviceLost { pass },
            Gpu::OutOfMemory { object, bytes, detail, may_pass } => {
                Error::OutOfMemory { object, bytes, detail, may_pass, instead: SMALLER_BATCHES }
            }
            Gpu::Claim { field, value, problem } => Error::config(field, value, problem),
            Gpu::Internal(fault) => Error::Internal(fault),
            other => Error::Internal(other.to_string()),
        }
    }
}
