//! The stages of a fit as X-Gaussian does it, what they bind, and one iteration of all sets, top to bottom:
//!
//! x_project -> (x_sort_count -> x_sort_scan -> x_sort_move) of each four bits -> x_lists -> x_blend -> ssim_rows ->
//! ssim_columns -> ssim_rows_back -> r2_residual -> x_blend_back -> x_update -> x_report

use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::dispatch::{Binding, BufferSet, buffer_set, dispatch_finding};
use crate::kernels::layout::{GaussianSetup, XSetup};
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage, along_two_axes};
use crate::x_gaussian::particles::{XLearningBuffers, XSeenBuffers};

/// Sums of a Gaussian over the pixels of a tile.
pub const SUMS: u32 = 7;
/// Number of keys of a block of the sort.
const KEYS_OF_BLOCK: u32 = 16 * push::XSortCount::LOCAL_SIZE;
const _: () = assert!(push::XSortMove::LOCAL_SIZE == push::XSortCount::LOCAL_SIZE);
/// Bits that a pass sorts by, and values that these have.
const BITS_OF_PASS: u32 = 4;
const DIGITS: u32 = 1 << BITS_OF_PASS;
/// Bits of a depth.
const DEPTH_BITS: u32 = 32;

/// Blocks of the sort of `n` keys.
pub fn sort_blocks(n: u32) -> u32 {
    n.div_ceil(KEYS_OF_BLOCK)
}

/// Passes of the sort: over depths, then over the sets' numbers.
fn sort_passes(n_sets: u32) -> u32 {
    let bits_of_sets = u32::BITS - n_sets.saturating_sub(1).leading_zeros();
    DEPTH_BITS / BITS_OF_PASS + bits_of_sets.div_ceil(BITS_OF_PASS)
}

/// Pipelines of pictures.
pub struct XPictureKernels {
    /// Projection of each Gaussian.
    pub project: Stage<push::XProject>,
    /// Sort, first pass.
    pub sort_count: Stage<push::XSortCount>,
    /// Sort, second pass.
    pub sort_scan: Stage<push::XSortScan>,
    /// Sort, last pass.
    pub sort_move: Stage<push::XSortMove>,
    /// Gaussians of each tile.
    pub lists: Stage<push::XLists>,
    /// Pictures.
    pub blend: Stage<push::XBlend>,
}

impl XPictureKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<XPictureKernels> {
        let plain = Build::default();
        Ok(XPictureKernels {
            project: plain.stage(gpu)?,
            sort_count: plain.stage(gpu)?,
            sort_scan: plain.stage(gpu)?,
            sort_move: plain.stage(gpu)?,
            lists: plain.stage(gpu)?,
            blend: plain.stage(gpu)?,
        })
    }
}

/// Pipelines of a fit.
pub struct XKernels {
    /// Pictures.
    pub pictures: XPictureKernels,
    /// SSIM, first pass.
    pub ssim_rows: Stage<push::SsimRows>,
    /// SSIM, second pass, and losses.
    pub ssim_columns: Stage<push::SsimColumns>,
    /// SSIM's gradient, first pass.
    pub ssim_rows_back: Stage<push::SsimRowsBack>,
    /// SSIM's gradient, second pass, and that of the loss.
    pub residual: Stage<push::R2Residual>,
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
            pictures: XPictureKernels::new(gpu)?,
            ssim_rows: plain.stage(gpu)?,
            ssim_columns: exchanges.stage(gpu)?,
            ssim_rows_back: plain.stage(gpu)?,
            residual: plain.stage(gpu)?,
            blend_back: plain.stage(gpu)?,
            update: plain.stage(gpu)?,
            report: exchanges.stage(gpu)?,
        })
    }
}

buffer_set! {
    /// Views and their pictures.
    pub struct XSceneBuffers {
        /// [`GaussianSetup`].
        gaussian_setup,
        /// [`XSetup`].
        x_setup,
        /// [`crate::kernels::layout::GaussianView`] of each image.
        gaussian_views,
        /// `[iteration][set]`: [`crate::kernels::layout::R2Turn`]s.
        r2_turns,
        /// Iterations done.
        gaussian_step,
        /// `[set][tile row][tile column]`: Gaussians that may show.
        x_tile_counts,
        /// [`crate::kernels::layout::XCounts`].
        x_counts,
        /// `[set][tile row][tile column]`: [`crate::kernels::layout::XList`]s.
        x_lists,
        /// `[set][pixel]`: pictures in fixed point.
        splat_images,
        /// `[set][pixel]`: [`crate::kernels::layout::XEnd`]s.
        x_ends,
    }
}

buffer_set! {
    /// Buffers of a fit, except for pictures and Gaussians.
    pub struct XFitBuffers {
        /// [`crate::kernels::layout::R2Setup`], of the stages that compare pictures.
        r2_setup,
        /// [`crate::kernels::layout::XSchedule`]s.
        x_schedule,
        /// `[image][pixel]`: target images.
        r2_targets,
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

/// A recording of pictures of `n` Gaussians.
pub struct XPicturePass<'a> {
    /// Recording that the stages are added to.
    pub recording: &'a mut Recording,
    /// The stages.
    pub kernels: &'a XPictureKernels,
    /// Views and pictures.
    pub scene: &'a XSceneBuffers,
    /// The Gaussians.
    pub seen: &'a XSeenBuffers,
    /// Constants on the host.
    pub x: &'a XSetup,
    /// Number of Gaussians of all sets.
    pub n: u32,
}

/// A workgroup per tile of all pictures.
fn tiles(x: &XSetup) -> Groups<'static> {
    Groups::Direct([x.tile_columns, x.tile_rows, x.n_sets])
}

impl XPicturePass<'_> {
    fn run<P: PushConstants>(
        &mut self,
        stage: &Stage<P>,
        groups: Groups<'_>,
        keys: [Binding; 2],
        push: P,
    ) -> Result<()> {
        let (scene, seen) = (self.scene, self.seen);
        let find = |name| scene.find(name).or_else(|| seen.find(name));
        let (from, to) = if keys[0] == Binding::x_keys {
            (&seen.x_keys, &seen.x_keys_moved)
        } else {
            (&seen.x_keys_moved, &seen.x_keys)
        };
        let bound = [(Binding::x_keys, from.into()), (Binding::x_keys_moved, to.into())];
        dispatch_finding(self.recording, stage, groups, &bound, find, push)
    }

    /// Records the pictures that the views of this iteration take.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
    pub fn record(&mut self) -> Result<()> {
        let (kernels, n, n_sets) = (self.kernels, self.n, self.x.n_sets);
        let mut keys = [Binding::x_keys, Binding::x_keys_moved];
        self.recording.fill(&self.scene.x_tile_counts, 0);
        self.recording.fill(&self.scene.x_counts, 0);
        let push = push::XProject { n_gaussians: n };
        self.run(&kernels.project, kernels.project.groups_over(n), keys, push)?;
        let n_blocks = sort_blocks(n);
        for pass in 0..sort_passes(n_sets) {
            let shift = BITS_OF_PASS * pass;
            let push = push::XSortCount { n_keys: n, n_blocks, shift };
            self.run(&kernels.sort_count, along_two_axes(n_blocks), keys, push)?;
            let push = push::XSortScan { n_counts: DIGITS * n_blocks };
            self.run(&kernels.sort_scan, Groups::Direct([1, 1, 1]), keys, push)?;
            let push = push::XSortMove { n_keys: n, n_blocks, shift };
            self.run(&kernels.sort_move, along_two_axes(n_blocks), keys, push)?;
            keys.reverse();
        }
        self.run(&kernels.lists, tiles(self.x), keys, push::XLists {})?;
        self.run(&kernels.blend, tiles(self.x), keys, push::XBlend {})
    }
}

/// Inputs of the stages of a fit.
#[derive(Clone, Copy)]
pub struct XParts<'a> {
    /// The stages.
    pub kernels: &'a XKernels,
    /// Views and pictures.
    pub scene: &'a XSceneBuffers,
    /// Buffers of the fit.
    pub fit: &'a XFitBuffers,
    /// The Gaussians.
    pub seen: &'a XSeenBuffers,
    /// State of the optimiser and statistics of the Gaussians.
    pub learning: &'a XLearningBuffers,
    /// Constants on the host.
    pub setup: &'a GaussianSetup,
    /// Constants of this method on the host.
    pub x: &'a XSetup,
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

    /// Workgroups of one invocation per pixel and set.
    fn pixels<P: PushConstants>(&self, stage: &Stage<P>) -> Groups<'static> {
        let n_pixels = self.setup.width * self.setup.height;
        Groups::Direct([n_pixels.div_ceil(stage.local_size()), self.x.n_sets, 1])
    }

    /// Records one iteration.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
    pub fn record_step(&self, recording: &mut Recording) -> Result<()> {
        let (kernels, n) = (self.kernels, self.n);
        let pictures = &kernels.pictures;
        let (scene, seen, x) = (self.scene, self.seen, self.x);
        XPicturePass { recording: &mut *recording, kernels: pictures, scene, seen, x, n }.record()?;
        self.run(recording, &kernels.ssim_rows, self.pixels(&kernels.ssim_rows), push::SsimRows {})?;
        self.run(recording, &kernels.ssim_columns, self.pixels(&kernels.ssim_columns), push::SsimColumns {})?;
        self.run(recording, &kernels.ssim_rows_back, self.pixels(&kernels.ssim_rows_back), push::SsimRowsBack {})?;
        self.run(recording, &kernels.residual, self.pixels(&kernels.residual), push::R2Residual {})?;
        self.run(recording, &kernels.blend_back, tiles(x), push::XBlendBack {})?;
        self.run(recording, &kernels.update, kernels.update.groups_over(n), push::XUpdate { n_gaussians: n })?;
        self.run(recording, &kernels.report, Groups::Direct([1, 1, 1]), push::XReport {})
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_are_sorted_by_as_few_bits_as_they_need() {
        let passes = [(1, 8), (2, 9), (10, 9), (16, 9), (17, 10), (256, 10), (257, 11)];
        passes.into_iter().for_each(|(n_sets, want)| assert_eq!(sort_passes(n_sets), want, "{n_sets}"));
        assert_eq!([1, 1024, 1025].map(sort_blocks), [1, 1, 2]);
    }
}
