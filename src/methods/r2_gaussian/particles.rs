//! Gaussians of R2-Gaussian on the device, and the results of an iteration for each.

use crate::error::Result;
use crate::gpu::buffer::Memory;
use crate::gpu::device::Gpu;
use crate::kernels::dispatch::{Binding, buffer_set};
use crate::kernels::layout::Splat;
use crate::methods::r2_gaussian::state::R2State;

buffer_set! {
    /// Gaussians on the device, and the results of an iteration for each.
    pub struct R2ParticleBuffers {
        /// [`crate::kernels::layout::R2Gaussian`]s.
        r2_gaussians,
        /// First moments of Adam, three vec4 per Gaussian: position and density, scale, rotation.
        gaussian_adam_first,
        /// Second moments of Adam, laid out alike.
        gaussian_adam_second,
        /// Gradient, laid out alike.
        gaussian_gradient,
        /// Statistics of density control, two numbers per Gaussian.
        r2_statistics,
        /// [`Splat`]s.
        splats,
        /// Picture that each splat belongs to.
        image_of_splat,
        /// Moments over each splat's pixels for the gradient: two vec4, or three where line integrals are exact.
        splat_moments,
        /// Moments over the voxels near each Gaussian for the gradient: three vec4.
        r2_voxel_moments,
    }
}

impl R2ParticleBuffers {
    /// Puts a state on the device.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn new(gpu: &Gpu, state: &R2State) -> Result<R2ParticleBuffers> {
        let n = state.rows.len() as u64;
        let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
        Ok(R2ParticleBuffers {
            r2_gaussians: gpu.buffer_with("r2_gaussians", &state.rows)?,
            gaussian_adam_first: gpu.buffer_with("gaussian_adam_first", &state.first)?,
            gaussian_adam_second: gpu.buffer_with("gaussian_adam_second", &state.second)?,
            gaussian_gradient: new(Binding::gaussian_gradient, 48 * n)?,
            r2_statistics: gpu.buffer_with("r2_statistics", &state.statistics)?,
            splats: new(Binding::splats, size_of::<Splat>() as u64 * n)?,
            image_of_splat: new(Binding::image_of_splat, 4 * n)?,
            splat_moments: new(Binding::splat_moments, 48 * n)?,
            r2_voxel_moments: new(Binding::r2_voxel_moments, 48 * n)?,
        })
    }

    /// Reads the first `n` Gaussians back.
    ///
    /// # Errors
    /// Device errors.
    pub fn download(&self, gpu: &Gpu, n: usize) -> Result<R2State> {
        Ok(R2State {
            rows: gpu.download(&self.r2_gaussians, 0, n)?,
            first: gpu.download(&self.gaussian_adam_first, 0, n)?,
            second: gpu.download(&self.gaussian_adam_second, 0, n)?,
            statistics: gpu.download(&self.r2_statistics, 0, n)?,
        })
    }
}
