//! Transfers between host and device: uploads, downloads, cells of images.

use super::buffer::{Buffer, Memory};
use super::device::Gpu;
use super::image::Image3d;
use super::record::{Commands, Recording};
use crate::error::{Error, Result};
use bytemuck::Pod;

/// Size of a staging buffer; larger copies go through several, to bound host memory.
const STAGING_BYTES: usize = 32 << 20;

impl Gpu {
    /// Makes a device buffer filled with `data`.
    ///
    /// # Errors
    /// Fails like [`Gpu::buffer`], or with the errors of the copy.
    pub fn buffer_with<T: Pod>(&self, name: &str, data: &[T]) -> Result<Buffer> {
        let buffer = self.buffer(name, size_of_val(data).max(16) as u64, Memory::Device)?;
        self.upload(&buffer, 0, data)?;
        Ok(buffer)
    }

    /// Copies `data` into `buffer` at `offset` bytes, and waits for the copy.
    ///
    /// # Errors
    /// [`Error::Internal`] when it does not fit; errors of the copy otherwise.
    pub fn upload<T: Pod>(&self, buffer: &Buffer, offset: u64, data: &[T]) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(data);
        buffer.check_range(offset, bytes.len() as u64)?;
        let mut at = offset;
        for part in bytes.chunks(STAGING_BYTES) {
            let staging = self.buffer("upload staging", part.len() as u64, Memory::Upload)?;
            staging.write(part)?;
            let mut recording = Recording::new(self, "upload")?;
            recording.copy(&staging, 0, buffer, at, part.len() as u64)?;
            self.wait(recording.finish()?.submit()?)?;
            at += part.len() as u64;
        }
        Ok(())
    }

    /// Reads `count` elements at `offset` bytes of `buffer`, after waiting for earlier submits.
    ///
    /// # Errors
    /// Fails like [`Gpu::upload`].
    pub fn download<T: Pod>(&self, buffer: &Buffer, offset: u64, count: usize) -> Result<Vec<T>> {
        let mut out = vec![T::zeroed(); count];
        let bytes: &mut [u8] = bytemuck::cast_slice_mut(&mut out);
        buffer.check_range(offset, bytes.len() as u64)?;
        let mut at = offset;
        for part in bytes.chunks_mut(STAGING_BYTES) {
            let staging = self.buffer("download staging", part.len() as u64, Memory::Readback)?;
            let mut recording = Recording::new(self, "download")?;
            recording.copy(buffer, at, &staging, 0, part.len() as u64)?;
            self.wait(recording.finish()?.submit()?)?;
            staging.read(part)?;
            at += part.len() as u64;
        }
        Ok(out)
    }
}

impl Image3d {
    /// Replaces all cells, x fastest, after the work submitted so far and before the work submitted next. Dropping the
    /// result waits for the copy.
    ///
    /// # Errors
    /// [`Error::Internal`] for a wrong number of cells; errors of the upload.
    pub fn fill(&self, cells: &[half::f16]) -> Result<Commands> {
        let bytes: &[u8] = bytemuck::cast_slice(cells);
        if bytes.len() as u64 != self.bytes() {
            return Err(Error::Internal(format!(
                "{} bytes were given for an image of {} bytes",
                bytes.len(),
                self.bytes()
            )));
        }
        let gpu = self.gpu();
        let staging = gpu.buffer("image staging", self.bytes(), Memory::Upload)?;
        staging.write(bytes)?;
        let mut recording = Recording::new(&gpu, "image upload")?;
        recording.fill_image(&staging, self)?;
        let commands = recording.finish()?;
        commands.submit()?;
        Ok(commands)
    }
}
