//! Gaussians of a deformable set with everything that each of them has of its own: shape, motion and, where contrast comes or goes,
//! filling.

use crate::error::Result;
use crate::gaussians::particles::{ParticleBuffers, Particles};
use crate::gpu::device::Gpu;
use crate::kernels::layout::GaussianSetup;
use crate::methods::dynamic_gaussians::filling::{Filling, FillingBuffers};
use crate::methods::dynamic_gaussians::stages::{OwnMotion, OwnMotionBuffers};

/// Gaussians with the optimiser's moments.
#[derive(Debug, Clone)]
pub(super) struct Members {
    pub(super) particles: Particles,
    pub(super) own: OwnMotion,
    /// None where vessels are full all the time.
    pub(super) filling: Option<Filling>,
}

/// Gaussians on the device.
pub(super) struct MemberBuffers {
    pub(super) particles: ParticleBuffers,
    pub(super) own: OwnMotionBuffers,
    pub(super) filling: Option<FillingBuffers>,
}

impl Members {
    /// Keeps the Gaussians marked in `keep`, one mark per Gaussian.
    pub(super) fn retain(&mut self, keep: &[bool]) {
        self.particles.retain(keep);
        self.own.retain(keep);
        if let Some(filling) = &mut self.filling {
            filling.retain(keep);
        }
    }

    /// Uploads the Gaussians to the device.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub(super) fn upload(&self, gpu: &Gpu, setup: &GaussianSetup) -> Result<MemberBuffers> {
        let n_places = self.particles.rows.len() as u64 * u64::from(setup.n_phases);
        Ok(MemberBuffers {
            particles: self.particles.upload(gpu, setup.n_views * setup.n_phases)?,
            own: self.own.upload(gpu, n_places)?,
            filling: self.filling.as_ref().map(|filling| filling.upload(gpu)).transpose()?,
        })
    }
}

impl MemberBuffers {
    /// Reads the first `n` Gaussians back, with `n_basis` vectors of own motion and `n_phases` fillings for each.
    ///
    /// # Errors
    /// Device errors.
    pub(super) fn download(&self, gpu: &Gpu, n: usize, n_basis: usize, n_phases: usize) -> Result<Members> {
        Ok(Members {
            particles: self.particles.download(gpu, n)?,
            own: self.own.download(gpu, n * n_basis)?,
            filling: self.filling.as_ref().map(|filling| filling.download(gpu, n * n_phases)).transpose()?,
        })
    }
}
