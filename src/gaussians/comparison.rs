//! The stages that compare the pictures of Gaussians with images, by an absolute difference and SSIM.

use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::gpu::record::Groups;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage};

/// Returns the number of partial sums of the loss of a picture.
pub fn picture_parts(n_pixels: u32) -> u32 {
    n_pixels.div_ceil(push::SsimColumns::LOCAL_SIZE)
}

/// Pipelines of the comparison.
pub struct ComparisonKernels {
    /// SSIM, first pass.
    pub ssim_rows: Stage<push::SsimRows>,
    /// SSIM, second pass, and losses.
    pub ssim_columns: Stage<push::SsimColumns>,
    /// SSIM's gradient, first pass.
    pub ssim_rows_back: Stage<push::SsimRowsBack>,
    /// SSIM's gradient, second pass, and that of the loss.
    pub picture_residual: Stage<push::PictureResidual>,
}

/// A stage of the comparison, ready to be recorded.
pub trait RecordStage {
    /// Records a stage.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
    fn record<P: PushConstants>(&mut self, stage: &Stage<P>, groups: Groups<'_>, push: P) -> Result<()>;
}

impl ComparisonKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<ComparisonKernels> {
        let plain = Build::default();
        Ok(ComparisonKernels {
            ssim_rows: plain.stage(gpu)?,
            ssim_columns: Build { exchanges: true, ..plain }.stage(gpu)?,
            ssim_rows_back: plain.stage(gpu)?,
            picture_residual: plain.stage(gpu)?,
        })
    }

    /// Records the comparison of the pictures of `n_sets` sets, of `n_pixels` pixels each: the loss and its gradient by each pixel.
    ///
    /// # Errors
    /// Errors of [`RecordStage::record`].
    pub fn record(&self, pass: &mut impl RecordStage, n_pixels: u32, n_sets: u32) -> Result<()> {
        fn pixels<P: PushConstants>(stage: &Stage<P>, n_pixels: u32, n_sets: u32) -> Groups<'static> {
            Groups::Direct([n_pixels.div_ceil(stage.local_size()), n_sets, 1])
        }
        pass.record(&self.ssim_rows, pixels(&self.ssim_rows, n_pixels, n_sets), push::SsimRows {})?;
        pass.record(&self.ssim_columns, pixels(&self.ssim_columns, n_pixels, n_sets), push::SsimColumns {})?;
        pass.record(&self.ssim_rows_back, pixels(&self.ssim_rows_back, n_pixels, n_sets), push::SsimRowsBack {})?;
        pass.record(&self.picture_residual, pixels(&self.picture_residual, n_pixels, n_sets), push::PictureResidual {})
    }
}
