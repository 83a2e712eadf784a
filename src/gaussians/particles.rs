//! Gaussians with the optimiser's moments, on the host and on the device. All arrays have one entry per Gaussian.

use crate::error::Result;
use crate::gpu::buffer::Memory;
use crate::gpu::device::Gpu;
use crate::kernels::dispatch::{Binding, buffer_set};
use crate::kernels::layout::{Gaussian, Splat};

/// Gaussians with Adam's moments.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Particles {
    /// Parameters.
    pub rows: Vec<Gaussian>,
    /// First moments: position and log-density, log-scale, rotation.
    pub first: Vec<[f32; 12]>,
    /// Second moments, in the same layout.
    pub second: Vec<[f32; 12]>,
}

/// Bytes of the moments of a splat: two vec4.
pub const MOMENTS_BYTES: u64 = 32;

buffer_set! {
    /// Gaussians on the device, and the values that an iteration computes for each.
    pub struct ParticleBuffers {
        /// [`Gaussian`]s.
        gaussians,
        /// First moments of Adam, three vec4 per Gaussian: position and log-density, log-scale, rotation.
        gaussian_adam_first,
        /// Second moments of Adam, in the same layout.
        gaussian_adam_second,
        /// Gradient, in the same layout.
        gaussian_gradient,
        /// [`Splat`]s, view by view.
        splats,
        /// Image that each splat belongs to, or -1.
        image_of_splat,
        /// Moments over each splat's pixels for the gradient, two vec4.
        splat_moments,
    }
}

impl Particles {
    /// Returns Gaussians with zero moments.
    pub fn fresh(rows: Vec<Gaussian>) -> Particles {
        let zeros = vec![[0.0; 12]; rows.len()];
        Particles { rows, first: zeros.clone(), second: zeros }
    }

    /// Keeps the Gaussians marked in `keep`, one mark per Gaussian.
    pub fn retain(&mut self, keep: &[bool]) {
        retain_marked(&mut self.rows, keep);
        retain_marked(&mut self.first, keep);
        retain_marked(&mut self.second, keep);
    }

    /// Appends Gaussians with zero moments.
    pub fn append(&mut self, rows: Vec<Gaussian>) {
        let fresh = Particles::fresh(rows);
        self.rows.extend(fresh.rows);
        self.first.extend(fresh.first);
        self.second.extend(fresh.second);
    }

    /// Uploads the Gaussians to the device, with room for splats in `n_views` views.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn upload(&self, gpu: &Gpu, n_views: u32) -> Result<ParticleBuffers> {
        let n = self.rows.len() as u64;
        let n_splats = n * u64::from(n_views);
        let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
        Ok(ParticleBuffers {
            gaussians: gpu.buffer_with("gaussians", &self.rows)?,
            gaussian_adam_first: gpu.buffer_with("gaussian_adam_first", &self.first)?,
            gaussian_adam_second: gpu.buffer_with("gaussian_adam_second", &self.second)?,
            gaussian_gradient: new(Binding::gaussian_gradient, 48 * n)?,
            splats: new(Binding::splats, size_of::<Splat>() as u64 * n_splats)?,
            image_of_splat: new(Binding::image_of_splat, 4 * n_splats)?,
            splat_moments: new(Binding::splat_moments, MOMENTS_BYTES * n_splats)?,
        })
    }
}

impl ParticleBuffers {
    /// Returns the same buffers with other moments, which have room for `n_splats`.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn with_moments(&self, gpu: &Gpu, n_splats: u64) -> Result<ParticleBuffers> {
        let splat_moments = gpu.buffer("splat_moments of a part", MOMENTS_BYTES * n_splats, Memory::Device)?;
        Ok(ParticleBuffers { splat_moments, ..self.clone() })
    }

    /// Reads the first `n` Gaussians back.
    ///
    /// # Errors
    /// Device errors.
    pub fn download(&self, gpu: &Gpu, n: usize) -> Result<Particles> {
        Ok(Particles {
            rows: gpu.download(&self.gaussians, 0, n)?,
            first: gpu.download(&self.gaussian_adam_first, 0, n)?,
            second: gpu.download(&self.gaussian_adam_second, 0, n)?,
        })
    }
}

/// Keeps the values of marked Gaussians; all Gaussians have the same number of values.
pub(crate) fn retain_marked<T>(values: &mut Vec<T>, keep: &[bool]) {
    let each = values.len() / keep.len().max(1);
    let mut at = 0..;
    values.retain(|_| at.next().is_some_and(|i| keep[i / each]));
}
