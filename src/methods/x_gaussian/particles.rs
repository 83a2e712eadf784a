//! Gaussians of X-Gaussian on the device: data for pictures, and data for the fit.

use crate::error::Result;
use crate::gaussians::blending::particles::BlendedGaussians;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::kernels::dispatch::{Binding, buffer_set};
use crate::methods::x_gaussian::state::XState;

/// Sums of a Gaussian over the pixels of a tile.
pub const SUMS: u32 = 7;

buffer_set! {
    /// State of the optimiser and statistics of each Gaussian.
    pub struct XLearningBuffers {
        /// First moments of Adam, three vec4 per Gaussian: position and opacity, scale and intensity, rotation.
        gaussian_adam_first,
        /// Second moments of Adam, laid out alike.
        gaussian_adam_second,
        /// Gradient, laid out alike.
        gaussian_gradient,
        /// [`crate::kernels::layout::XStatistics`].
        x_statistics,
        /// `[entry][sum]`: sums over tiles, for gradients.
        x_entries,
    }
}

impl XLearningBuffers {
    /// Puts a state on the device, and room for the gradients of `capacity` Gaussians in all tiles' lists.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn new(gpu: &Gpu, state: &XState, capacity: u32) -> Result<XLearningBuffers> {
        let n = state.rows.len() as u64;
        Ok(XLearningBuffers {
            gaussian_adam_first: gpu.buffer_with("gaussian_adam_first", &state.first)?,
            gaussian_adam_second: gpu.buffer_with("gaussian_adam_second", &state.second)?,
            gaussian_gradient: gpu.buffer(Binding::gaussian_gradient.name(), 48 * n, Memory::Device)?,
            x_statistics: gpu.buffer_with("x_statistics", &state.statistics)?,
            x_entries: entries(gpu, capacity)?,
        })
    }

    /// Makes room for the gradients of `capacity` Gaussians in lists.
    ///
    /// # Errors
    /// As [`XLearningBuffers::new`].
    pub fn make_room(&mut self, gpu: &Gpu, capacity: u32) -> Result<()> {
        self.x_entries = entries(gpu, capacity)?;
        Ok(())
    }
}

fn entries(gpu: &Gpu, capacity: u32) -> Result<Buffer> {
    Ok(gpu.buffer(Binding::x_entries.name(), 4 * u64::from(SUMS) * u64::from(capacity), Memory::Device)?)
}

/// Reads the state of Gaussians back, whose sets are known.
///
/// # Errors
/// Device errors.
pub fn download(gpu: &Gpu, seen: &BlendedGaussians, learning: &XLearningBuffers, sets: &[u32]) -> Result<XState> {
    let n = sets.len();
    Ok(XState {
        rows: gpu.download(&seen.blend_gaussians, 0, n)?,
        sets: sets.to_vec(),
        first: gpu.download(&learning.gaussian_adam_first, 0, n)?,
        second: gpu.download(&learning.gaussian_adam_second, 0, n)?,
        statistics: gpu.download(&learning.x_statistics, 0, n)?,
    })
}
