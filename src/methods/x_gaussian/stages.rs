//! The stages of a fit as X-Gaussian does it, what they bind, and one iteration of all sets, top to bottom:
//!
//! blend_project -> (blend_sort_count -> blend_sort_scan -> blend_sort_move) of each four bits -> blend_lists -> blend_picture -> ssim_rows ->
//! ssim_columns -> ssim_rows_back -> picture_residual -> x_blend_back -> x_update -> x_report

use crate::error::Result;
use crate::gaussians::blending::particles::BlendedGaussians;
use crate::gaussians::blending::stages::{BlendBuffers, BlendKernels, BlendPass, tiles};
use crate::gaussians::comparison::{ComparisonKernels, RecordStage};
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::dispatch::{BufferSet, buffer_set, dispatch_finding};
use crate::kernels::layout::{BlendSetup, GaussianSetup};
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage};
use crate::methods::x_gaussian::particles::XLearningBuffers;

/// Pipelines of a fit.
pub struct XKernels {
    /// Pictures.
    pub pictures: BlendKernels,
    /// Comparison of pictures with images.
    pub comparison: ComparisonKernels,
    /// Sums over the tiles, for gradients.
    pub blend_back: Stage<push::XBlendBack>,
    /// Gradients, density control's statistics, and the optimiser.
    pub update: Stage<push::XUpdate>,
    /// Loss and step count.
    pub report: Stage<push::XReport>,
}

impl XKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<XKernels> {
        let plain = Build::default();
        let exchanges = Build { exchanges: true, ..plain };
        Ok(XKernels {
            pictures: BlendKernels::new(gpu)?,
            comparison: ComparisonKernels::new(gpu)?,
            blend_back: plain.stage(gpu)?,
            update: plain.stage(gpu)?,
            report: exchanges.stage(gpu)?,
        })
    }
}

buffer_set! {
    /// Buffers of a fit, except for pictures and Gaussians.
    pub struct XFitBuffers {
        /// [`crate::kernels::layout::PictureSetup`], of the stages that compare pictures.
        picture_setup,
        /// [`crate::kernels::layout::XSchedule`]s.
        x_schedule,
        /// `[image][pixel]`: target images.
        picture_targets,
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
        /// Partial sums of the loss.
        gaussian_loss_parts,
        /// Losses of the last iterations.
        gaussian_ring,
        /// [`crate::kernels::layout::XStatus`].
        x_status,
    }
}

/// Inputs of the stages of a fit.
#[derive(Clone, Copy)]
pub struct XParts<'a> {
    /// The stages.
    pub kernels: &'a XKernels,
    /// Views and pictures.
    pub scene: &'a BlendBuffers,
    /// Buffers of the fit.
    pub fit: &'a XFitBuffers,
    /// The Gaussians.
    pub seen: &'a BlendedGaussians,
    /// State of the optimiser and statistics of the Gaussians.
    pub learning: &'a XLearningBuffers,
    /// Constants on the host.
    pub setup: &'a GaussianSetup,
    /// Constants of this method on the host.
    pub x: &'a BlendSetup,
    /// Number of Gaussians of all sets.
    pub n: u32,
}

impl XParts<'_> {
    fn run<P: PushConstants>(
        &self,
        recording: &mut Recording,
        stage: &Stage<P>,
        groups: Groups<'_>,
        push: P,
    ) -> Result<()> {
        let find = |name| {
            let of_pictures = self.scene.find(name).or_else(|| self.seen.find(name));
            of_pictures.or_else(|| self.fit.find(name)).or_else(|| self.learning.find(name))
        };
        dispatch_finding(recording, stage, groups, &[], find, push)
    }

    /// Records one iteration.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
    pub fn record_step(&self, recording: &mut Recording) -> Result<()> {
        let (kernels, n) = (self.kernels, self.n);
        let pictures = &kernels.pictures;
        let (scene, seen, x) = (self.scene, self.seen, self.x);
        BlendPass { recording: &mut *recording, kernels: pictures, scene, seen, x, n }.record()?;
        let n_pixels = self.setup.width * self.setup.height;
        kernels.comparison.record(&mut XRecording { parts: self, recording: &mut *recording }, n_pixels, x.n_sets)?;
        self.run(recording, &kernels.blend_back, tiles(x), push::XBlendBack {})?;
        self.run(recording, &kernels.update, kernels.update.groups_over(n), push::XUpdate { n_gaussians: n })?;
        self.run(recording, &kernels.report, Groups::Direct([1, 1, 1]), push::XReport {})
    }
}

/// Recording of stages with the buffers that they bind.
struct XRecording<'a, 'b> {
    parts: &'a XParts<'b>,
    recording: &'a mut Recording,
}

impl RecordStage for XRecording<'_, '_> {
    fn record<P: PushConstants>(&mut self, stage: &Stage<P>, groups: Groups<'_>, push: P) -> Result<()> {
        self.parts.run(self.recording, stage, groups, push)
    }
}
