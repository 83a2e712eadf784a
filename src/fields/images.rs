//! Line integrals of the training images on the device, in as many buffers as its limit on the size of one asks for.

use crate::error::Result;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::kernels::layout;
use std::ops::Range;

/// Line integrals of the training images.
pub struct TrainingImages {
    n_frames: usize,
    n_pixels: usize,
    /// Maximum number of images in a buffer.
    per_buffer: usize,
    buffers: Vec<Buffer>,
}

/// Returns the number of images of `n_pixels` pixels that a buffer of at most `max_bytes` bytes holds, at least one.
fn images_per_buffer(max_bytes: u32, n_pixels: usize) -> usize {
    (max_bytes as usize / (size_of::<f32>() * n_pixels.max(1))).max(1)
}

impl TrainingImages {
    /// Makes buffers for `n_frames` images of `n_pixels` pixels, contents undefined.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer, also where a single image is larger than the device's largest buffer.
    pub fn new(gpu: &Gpu, n_frames: usize, n_pixels: usize) -> Result<TrainingImages> {
        let per_buffer = images_per_buffer(gpu.info().max_storage_buffer_range, n_pixels);
        let buffer = |first: usize| {
            let n = per_buffer.min(n_frames - first);
            gpu.buffer("images", (n * n_pixels * size_of::<f32>()) as u64, Memory::Device)
        };
        let buffers = (0..n_frames).step_by(per_buffer).map(buffer).collect::<std::result::Result<_, _>>()?;
        Ok(TrainingImages { n_frames, n_pixels, per_buffer, buffers })
    }

    /// Replaces the line integrals of a frame.
    ///
    /// # Errors
    /// Device errors.
    pub fn write(&self, gpu: &Gpu, frame: usize, integrals: &[f32]) -> Result<()> {
        let offset = frame % self.per_buffer * self.n_pixels * size_of::<f32>();
        Ok(gpu.upload(&self.buffers[frame / self.per_buffer], offset as u64, integrals)?)
    }

    /// Buffers, and the frames whose images are in them.
    pub fn buffers(&self) -> impl Iterator<Item = (Range<u32>, &Buffer)> {
        let frames = |k: usize| k * self.per_buffer..((k + 1) * self.per_buffer).min(self.n_frames);
        self.buffers.iter().enumerate().map(move |(k, buffer)| (frames(k).start as u32..frames(k).end as u32, buffer))
    }
}

/// Returns the frames with the offsets that [`TrainingImages`] give their images of `n_pixels` pixels.
pub(crate) fn placed(gpu: &Gpu, frames: &[layout::Frame], n_pixels: usize) -> Vec<layout::Frame> {
    let per_buffer = images_per_buffer(gpu.info().max_storage_buffer_range, n_pixels);
    let offset = |index: usize| (index % per_buffer * n_pixels) as u32;
    frames.iter().enumerate().map(|(k, frame)| layout::Frame { image_offset: offset(k), ..*frame }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_buffer_holds_whole_images() {
        assert_eq!(images_per_buffer(1 << 27, 1024 * 1024), 32);
        assert_eq!(images_per_buffer(1 << 27, 1000 * 1001), 33);
        assert_eq!(images_per_buffer(16, 7), 1, "the buffer refuses an image that is too large");
    }
}
