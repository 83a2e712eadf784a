//! The stages of a fit as R2-Gaussian does it, what they bind, and one iteration of all sets, top to bottom:
//!
//! r2_project -> gaussian_splat -> ssim_rows -> ssim_columns -> ssim_rows_back -> picture_residual -> gaussian_moments ->
//! r2_voxel_splat -> r2_voxel_tv -> r2_voxel_moments -> r2_update -> gaussian_report
//!
//! Where line integrals are exact, r2_chord_splat and r2_chord_moments take the places of gaussian_splat and gaussian_moments.

use crate::config::R2Integral;
use crate::error::Result;
use crate::gaussians::comparison::{ComparisonKernels, RecordStage, picture_parts};
use crate::gaussians::stages::SplatStage;
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::dispatch::{BufferSet, buffer_set, dispatch_finding};
use crate::kernels::layout::{GaussianSetup, R2Setup};
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage};
use crate::methods::r2_gaussian::particles::R2ParticleBuffers;

/// Pipelines that compute how pixels see Gaussians.
pub enum R2PictureKernels {
    /// [`R2Integral::Affine`].
    Affine {
        /// Pictures.
        splat: SplatStage<push::GaussianSplat>,
        /// Moments over the pixels, for gradients.
        moments: SplatStage<push::GaussianMoments>,
    },
    /// [`R2Integral::Exact`].
    Exact {
        /// Pictures.
        splat: SplatStage<push::R2ChordSplat>,
        /// Moments over the pixels, for gradients.
        moments: SplatStage<push::R2ChordMoments>,
    },
}

impl R2PictureKernels {
    fn new(gpu: &Gpu, integral: R2Integral) -> Result<R2PictureKernels> {
        Ok(match integral {
            R2Integral::Affine => {
                R2PictureKernels::Affine { splat: SplatStage::new(gpu)?, moments: SplatStage::new(gpu)? }
            }
            R2Integral::Exact => {
                R2PictureKernels::Exact { splat: SplatStage::new(gpu)?, moments: SplatStage::new(gpu)? }
            }
        })
    }
}

/// Pipelines of a fit.
pub struct R2Kernels {
    /// Projection of each Gaussian.
    pub project: Stage<push::R2Project>,
    /// Pictures, and their moments for gradients.
    pub pictures: R2PictureKernels,
    /// Comparison of pictures with images.
    pub comparison: ComparisonKernels,
    /// Attenuation at the boxes' voxels.
    pub voxel_splat: SplatStage<push::R2VoxelSplat>,
    /// Total variation.
    pub voxel_tv: Stage<push::R2VoxelTv>,
    /// Moments over the voxels, for gradients.
    pub voxel_moments: SplatStage<push::R2VoxelMoments>,
    /// Gradients, density control's statistic, and the optimiser.
    pub update: Stage<push::R2Update>,
    /// Loss and step count.
    pub report: Stage<push::GaussianReport>,
}

impl R2Kernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu, integral: R2Integral) -> Result<R2Kernels> {
        let plain = Build::default();
        let exchanges = Build { exchanges: true, ..plain };
        Ok(R2Kernels {
            project: plain.stage(gpu)?,
            pictures: R2PictureKernels::new(gpu, integral)?,
            comparison: ComparisonKernels::new(gpu)?,
            voxel_splat: SplatStage::new(gpu)?,
            voxel_tv: exchanges.stage(gpu)?,
            voxel_moments: SplatStage::new(gpu)?,
            update: plain.stage(gpu)?,
            report: exchanges.stage(gpu)?,
        })
    }
}

buffer_set! {
    /// Buffers of a fit, except for the Gaussians.
    pub struct R2Buffers {
        /// [`GaussianSetup`].
        gaussian_setup,
        /// [`R2Setup`].
        r2_setup,
        /// [`crate::kernels::layout::PictureSetup`], of the stages that compare pictures.
        picture_setup,
        /// [`crate::kernels::layout::GaussianView`] of each image.
        gaussian_views,
        /// `[iteration][set]`: [`crate::kernels::layout::PictureTurn`]s.
        picture_turns,
        /// [`crate::kernels::layout::R2Schedule`]s.
        r2_schedule,
        /// Iterations done.
        gaussian_step,
        /// `[image][pixel]`: target line integrals.
        picture_targets,
        /// `[set][pixel]`: pictures in fixed point.
        splat_images,
        /// `[set][pixel]`: gradient of the loss.
        splat_image_gradient,
        /// `[set][pixel]`: SSIM's sums along rows.
        ssim_row_sums,
        /// `[set][pixel]`: one more of SSIM's sums along rows.
        ssim_row_products,
        /// `[set][pixel]`: factors of SSIM's gradient, and its value.
        ssim_factors,
        /// `[set][pixel]`: the factors' sums along rows.
        ssim_row_factors,
        /// `[set][voxel]`: attenuation in fixed point.
        r2_voxel_sums,
        /// `[set][voxel]`: gradient of the loss.
        r2_voxel_gradient,
        /// Partial sums of the loss.
        gaussian_loss_parts,
        /// Losses of the last iterations.
        gaussian_ring,
    }
}

/// Partial sums of the total variation of a box.
pub fn box_parts(box_side: u32) -> u32 {
    box_side.pow(3).div_ceil(push::R2VoxelTv::LOCAL_SIZE)
}

/// Inputs of the stages of a fit.
#[derive(Clone, Copy)]
pub struct R2Parts<'a> {
    /// The stages.
    pub kernels: &'a R2Kernels,
    /// Buffers of the fit.
    pub buffers: &'a R2Buffers,
    /// The Gaussians.
    pub particles: &'a R2ParticleBuffers,
    /// Constants on the host.
    pub setup: &'a GaussianSetup,
    /// Constants of this method on the host.
    pub r2: &'a R2Setup,
    /// Number of Gaussians of all sets.
    pub n: u32,
}

/// A recording of stages.
pub struct R2Pass<'a> {
    /// Recording that the stages are added to.
    pub recording: &'a mut Recording,
    /// Inputs of the stages.
    pub parts: R2Parts<'a>,
}

impl R2Pass<'_> {
    fn run<P: PushConstants>(&mut self, stage: &Stage<P>, groups: Groups<'_>, push: P) -> Result<()> {
        let R2Parts { buffers, particles, .. } = self.parts;
        let find = |name| buffers.find(name).or_else(|| particles.find(name));
        dispatch_finding(self.recording, stage, groups, &[], find, push)
    }

    /// Records the pictures that the views of this iteration take.
    fn pictures(&mut self) -> Result<()> {
        let R2Parts { kernels, n, buffers, .. } = self.parts;
        self.recording.fill(&buffers.splat_images, 0);
        self.run(&kernels.project, kernels.project.groups_over(n), push::R2Project { n_gaussians: n })?;
        match &kernels.pictures {
            R2PictureKernels::Affine { splat, .. } => {
                self.run(&splat.stage, splat.groups_for(n), push::GaussianSplat { n_splats: n })
            }
            R2PictureKernels::Exact { splat, .. } => {
                self.run(&splat.stage, splat.groups_for(n), push::R2ChordSplat { n_gaussians: n })
            }
        }
    }

    /// Records the loss of the pictures, its gradient, and the moments that gradients of Gaussians need of it.
    fn compare_pictures(&mut self) -> Result<()> {
        let R2Parts { kernels, n, setup, r2, .. } = self.parts;
        kernels.comparison.record(self, setup.width * setup.height, r2.n_sets)?;
        match &kernels.pictures {
            R2PictureKernels::Affine { moments, .. } => {
                self.run(&moments.stage, moments.groups_for(n), push::GaussianMoments { n_splats: n })
            }
            R2PictureKernels::Exact { moments, .. } => {
                self.run(&moments.stage, moments.groups_for(n), push::R2ChordMoments { n_gaussians: n })
            }
        }
    }

    /// Records the total variation of this iteration's boxes, and the moments that gradients need of it.
    fn smooth_voxels(&mut self) -> Result<()> {
        let R2Parts { kernels, n, buffers, setup, r2, .. } = self.parts;
        self.recording.fill(&buffers.r2_voxel_sums, 0);
        let splat = &kernels.voxel_splat;
        self.run(&splat.stage, splat.groups_for(n), push::R2VoxelSplat { n_gaussians: n })?;
        let groups = Groups::Direct([box_parts(r2.box_side), r2.n_sets, 1]);
        let first_part = picture_parts(setup.width * setup.height) * r2.n_sets;
        self.run(&kernels.voxel_tv, groups, push::R2VoxelTv { first_part })?;
        let moments = &kernels.voxel_moments;
        self.run(&moments.stage, moments.groups_for(n), push::R2VoxelMoments { n_gaussians: n })
    }
}

impl RecordStage for R2Pass<'_> {
    fn record<P: PushConstants>(&mut self, stage: &Stage<P>, groups: Groups<'_>, push: P) -> Result<()> {
        self.run(stage, groups, push)
    }
}

/// Records one iteration.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_step(pass: &mut R2Pass<'_>) -> Result<()> {
    let R2Parts { kernels, n, r2, .. } = pass.parts;
    pass.pictures()?;
    pass.compare_pictures()?;
    if r2.tv_weight > 0.0 {
        pass.smooth_voxels()?;
    }
    pass.run(&kernels.update, kernels.update.groups_over(n), push::R2Update { n_gaussians: n })?;
    pass.run(&kernels.report, Groups::Direct([1, 1, 1]), push::GaussianReport {})
}
