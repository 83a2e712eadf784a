//! The pipeline cache on disk, so that the next start of a program compiles nothing.

use crate::error::Result;
use crate::files;
use crate::gpu::device::Gpu;

/// Writes the pipeline cache of a device into the file that the device was opened with; does nothing without one.
///
/// # Errors
/// [`crate::error::Error::Io`] when the directory cannot be written; device errors.
pub fn save_pipeline_cache(gpu: &Gpu) -> Result<()> {
    match gpu.pipeline_cache()? {
        Some((file, content)) => Ok(files::write_atomic(file, &content)?),
        None => Ok(()),
    }
}
