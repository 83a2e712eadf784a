//! The stages of a fit of Gaussians, their buffers, and one iteration on a set per phase, in this order:
//!
//! gaussian_project -> gaussian_splat -> gaussian_residual -> gaussian_moments -> gaussian_update -> gaussian_report

use crate::error::Result;
use crate::gaussians::particles::ParticleBuffers;
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::constants;
use crate::kernels::dispatch::{BufferSet, buffer_set, dispatch_finding};
use crate::kernels::layout::GaussianSetup;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage, along_two_axes, full_subgroup};
use std::ops::Range;

/// Fractional bits of the integer sums: images hold up to 2048 times the strongest change, in steps of 1e-6.
pub const FIXED_POINT_BITS: i32 = 20;

/// Pipelines of a fit.
pub struct GaussianKernels {
    /// Projection of the Gaussians of a set per phase into every view.
    pub project: Stage<push::GaussianProject>,
    /// Images of the Gaussians.
    pub splat: SplatStage<push::GaussianSplat>,
    /// Residuals, their gradients and losses.
    pub residual: Stage<push::GaussianResidual>,
    /// Moments of the image gradients over each splat's pixels.
    pub moments: SplatStage<push::GaussianMoments>,
    /// Gradients and the optimiser.
    pub update: Stage<push::GaussianUpdate>,
    /// Loss and step count.
    pub report: Stage<push::GaussianReport>,
}

/// A stage on splats. Several lanes of a subgroup share a splat where they can exchange values.
pub struct SplatStage<P> {
    pub(crate) stage: Stage<P>,
    lanes_per_splat: u32,
}

/// Maximum number of lanes that share a splat, which covers some hundred pixels.
const LANES_PER_SPLAT: u32 = 8;
impl<P: PushConstants> SplatStage<P> {
    /// Builds the pipeline.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<SplatStage<P>> {
        let subgroup = full_subgroup(gpu, P::LOCAL_SIZE);
        let lanes_per_splat = subgroup.map_or(1, |size| size.min(LANES_PER_SPLAT));
        let lanes = [("lanes_per_splat", lanes_per_splat)];
        let constants: &[_] = if subgroup.is_some() { &lanes } else { &[] };
        Ok(SplatStage { stage: Build { constants, exchanges: true, ..Build::default() }.stage(gpu)?, lanes_per_splat })
    }

    /// Returns the workgroups for a number of splats, along two axes where one axis is too short.
    pub fn groups_for(&self, n_splats: u32) -> Groups<'static> {
        along_two_axes(n_splats.div_ceil(self.stage.local_size() / self.lanes_per_splat))
    }
}

impl GaussianKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<GaussianKernels> {
        let plain = Build::default();
        let exchanges = Build { exchanges: true, ..plain };
        Ok(GaussianKernels {
            project: plain.stage(gpu)?,
            splat: SplatStage::new(gpu)?,
            residual: exchanges.stage(gpu)?,
            moments: SplatStage::new(gpu)?,
            update: plain.stage(gpu)?,
            report: exchanges.stage(gpu)?,
        })
    }
}

buffer_set! {
    /// Target data of a fit of Gaussians, and its counters.
    pub struct TargetBuffers {
        /// [`GaussianSetup`].
        gaussian_setup,
        /// [`crate::kernels::layout::GaussianView`]s.
        gaussian_views,
        /// `[phase][view]`: index of the image, or -1.
        image_of_view,
        /// `[image][pixel]`: lower bound of the dynamic field's line integral.
        bound_low,
        /// `[image][pixel]`: upper bound of the dynamic field's line integral.
        bound_high,
        /// `[image][pixel]`: factor on the residual.
        pixel_weight,
        /// [`crate::kernels::layout::GaussianSchedule`]s.
        gaussian_schedule,
        /// `[image][pixel]`: images of the Gaussians in fixed point; zero between iterations.
        splat_images,
        /// `[image][pixel]`: gradient of the loss.
        splat_image_gradient,
        /// Partial sums of the loss.
        gaussian_loss_parts,
        /// Iterations done.
        gaussian_step,
        /// Losses of the last iterations.
        gaussian_ring,
    }
}

/// Returns the number of partial sums of the loss over `n_quads` groups of four pixels.
pub fn loss_parts(n_quads: u32) -> u32 {
    n_quads.div_ceil(constants::gaussian_residual::QUADS * push::GaussianResidual::LOCAL_SIZE)
}

/// A recording of stages on `n` Gaussians.
pub struct GaussianPass<'a> {
    /// Recording that the stages are added to.
    pub recording: &'a mut Recording,
    /// The stages.
    pub kernels: &'a GaussianKernels,
    /// Target data of the fit.
    pub targets: &'a TargetBuffers,
    /// The Gaussians.
    pub particles: &'a ParticleBuffers,
    /// Constants on the host.
    pub setup: &'a GaussianSetup,
    /// Number of Gaussians.
    pub n: u32,
}

impl GaussianPass<'_> {
    /// Records a stage that finds its buffers in this pass or in `more`.
    pub(crate) fn run<P: PushConstants>(
        &mut self,
        stage: &Stage<P>,
        groups: Groups<'_>,
        more: &[&dyn BufferSet],
        push: P,
    ) -> Result<()> {
        let (targets, particles) = (self.targets, self.particles);
        let others = |name| more.iter().find_map(|set| set.find(name));
        let find = |name| targets.find(name).or_else(|| particles.find(name)).or_else(|| others(name));
        dispatch_finding(self.recording, stage, groups, &[], find, push)
    }

    /// Records the images of splats that have already been projected.
    pub(crate) fn splats(&mut self, n_splats: u32) -> Result<()> {
        let splat = &self.kernels.splat;
        self.run(&splat.stage, splat.groups_for(n_splats), &[], push::GaussianSplat { n_splats })
    }

    /// Records the residuals of some images, and the moments of all splats.
    pub(crate) fn residual(&mut self, images: Range<u32>, n_splats: u32) -> Result<()> {
        let [first_quad, n_quads] = [images.start, images.len() as u32].map(|n| n * self.setup.image_stride / 4);
        let GaussianKernels { residual, moments, .. } = self.kernels;
        let push = push::GaussianResidual { first_quad, n_quads };
        let groups = Groups::Direct([loss_parts(n_quads).max(1), 1, 1]);
        self.run(residual, groups, &[], push)?;
        self.run(&moments.stage, moments.groups_for(n_splats), &[], push::GaussianMoments { n_splats })
    }

    /// Records the end of an iteration: its loss and the step count.
    pub(crate) fn report(&mut self) -> Result<()> {
        self.run(&self.kernels.report, Groups::Direct([1, 1, 1]), &[], push::GaussianReport {})
    }
}

/// Records the images of Gaussians of a set per phase; the images must be zero.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_images(pass: &mut GaussianPass<'_>) -> Result<()> {
    let (project, n) = (&pass.kernels.project, pass.n);
    let groups = Groups::Direct([n.div_ceil(project.local_size()), pass.setup.n_views, 1]);
    pass.run(project, groups, &[], push::GaussianProject { n_gaussians: n })?;
    pass.splats(n * pass.setup.n_views)
}

/// Records one iteration on Gaussians of a set per phase.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_step(pass: &mut GaussianPass<'_>) -> Result<()> {
    let (update, setup, n) = (&pass.kernels.update, pass.setup, pass.n);
    record_images(pass)?;
    pass.residual(0..setup.n_images, n * setup.n_views)?;
    pass.run(update, update.groups_for(n), &[], push::GaussianUpdate { n_gaussians: n })?;
    pass.report()
}
