//! Gaussians of a deformable set with everything that each of them has of its own: shape, motion and, where contrast comes or goes,
//! filling.

use crate::error::Result;
use crate::gaussians::field::MovingGaussians;
use crate::gaussians::particles::{ParticleBuffers, Particles};
use crate::gpu::device::Gpu;
use crate::kernels::layout::{Gaussian, GaussianSetup};
use crate::methods::dynamic_gaussians::deformable::filling::{Filling, FillingBuffers};
use crate::methods::dynamic_gaussians::deformable::stages::{OwnMotion, OwnMotionBuffers};
use glam::DVec3;

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
    /// Returns no Gaussians, to which some can be appended.
    pub(super) fn none(has_fillings: bool) -> Members {
        let filling = has_fillings.then(|| Filling::fresh(Vec::new()));
        Members { particles: Particles::fresh(Vec::new()), own: OwnMotion::fresh(Vec::new()), filling }
    }

    /// Appends Gaussians of the rest phase, each of which moves and is filled as its nearest neighbour in a deformable set.
    pub(super) fn append(&mut self, rows: Vec<Gaussian>, deformable: &MovingGaussians) {
        let (n_basis, n_phases) = (deformable.setup.n_basis as usize, deformable.rest.n_phases);
        for g in &rows {
            let nearest = deformable.nearest(DVec3::from_array(g.position.map(f64::from)));
            self.own.append(deformable.own[nearest * n_basis..][..n_basis].to_vec());
            if let (Some(filling), Some(values)) = (&mut self.filling, &deformable.filling) {
                filling.append(values[nearest * n_phases..][..n_phases].to_vec());
            }
        }
        self.particles.append(rows);
    }

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
