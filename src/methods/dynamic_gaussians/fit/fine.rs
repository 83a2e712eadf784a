//! Last part of a fit that began on coarser images, with all pixels.

use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::methods::dynamic_gaussians::deformable::{DeformableTrainer, Earlier};
use crate::methods::dynamic_gaussians::remainder::MIN_PHASES;
use crate::methods::dynamic_gaussians::rules::{NOISE_SCALE, Rules};
use crate::methods::dynamic_gaussians::setup;
use crate::methods::dynamic_gaussians::targets::Targets;

/// Images with all pixels, for a fit that begins on coarser ones.
pub(crate) struct Fine {
    gpu: Gpu,
    targets: Targets,
    config: Rules,
    /// Iteration from which on all pixels are used.
    from: u32,
}

impl Fine {
    /// Returns the targets that a fit begins on, and those that it ends on where they are finer.
    pub(crate) fn split(gpu: &Gpu, targets: Targets, config: &Rules) -> (Targets, Option<Box<Fine>>) {
        let factor = targets.coarse_factor();
        match setup::fine_step(&config.gaussians).filter(|_| factor > 1) {
            Some(from) => {
                let coarse = targets.coarser(factor, NOISE_SCALE);
                let mut targets = targets;
                // All pixels are used from a renewal of the bounds on, which needs upper bounds alone.
                if targets.fewest_phases() >= MIN_PHASES {
                    targets.low = Vec::new();
                }
                (coarse, Some(Box::new(Fine { gpu: gpu.clone(), targets, config: config.clone(), from })))
            }
            None => (targets, None),
        }
    }

    /// Returns the iteration from which on all pixels are used.
    pub(crate) fn from(&self) -> u32 {
        self.from
    }

    /// Goes on from the deformable set that was fitted to the coarser images.
    ///
    /// # Errors
    /// As [`DeformableTrainer::with`] and [`DeformableTrainer::deformable`].
    pub(crate) fn go_on(self, coarse: &DeformableTrainer) -> Result<DeformableTrainer> {
        let earlier = Earlier { field: &coarse.deformable()?, step: self.from, reseeds: false };
        DeformableTrainer::after(&self.gpu, self.targets, &self.config, earlier)
    }
}
