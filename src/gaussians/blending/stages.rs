//! The stages that draw Gaussians of which nearer ones hide those behind them, what they bind, and a picture of each set:
//!
//! blend_project -> (blend_sort_count -> blend_sort_scan -> blend_sort_move) of each four bits -> blend_lists -> blend_picture

use crate::error::Result;
use crate::gaussians::blending::particles::{BlendedGaussians, sort_blocks};
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::dispatch::{Binding, BufferSet, buffer_set, dispatch_finding};
use crate::kernels::layout::BlendSetup;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage, along_two_axes};

/// Bits that a pass sorts by, and values that these have.
const BITS_OF_PASS: u32 = 4;
const DIGITS: u32 = 1 << BITS_OF_PASS;
/// Bits of a depth.
const DEPTH_BITS: u32 = 32;

/// Passes of the sort: over depths, then over the sets' numbers.
fn sort_passes(n_sets: u32) -> u32 {
    let bits_of_sets = u32::BITS - n_sets.saturating_sub(1).leading_zeros();
    DEPTH_BITS / BITS_OF_PASS + bits_of_sets.div_ceil(BITS_OF_PASS)
}

/// Pipelines of pictures.
pub struct BlendKernels {
    /// Projection of each Gaussian.
    pub project: Stage<push::BlendProject>,
    /// Sort, first pass.
    pub sort_count: Stage<push::BlendSortCount>,
    /// Sort, second pass.
    pub sort_scan: Stage<push::BlendSortScan>,
    /// Sort, last pass.
    pub sort_move: Stage<push::BlendSortMove>,
    /// Gaussians of each tile.
    pub lists: Stage<push::BlendLists>,
    /// Pictures.
    pub blend: Stage<push::BlendPicture>,
}

impl BlendKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<BlendKernels> {
        let plain = Build::default();
        Ok(BlendKernels {
            project: plain.stage(gpu)?,
            sort_count: plain.stage(gpu)?,
            sort_scan: plain.stage(gpu)?,
            sort_move: plain.stage(gpu)?,
            lists: plain.stage(gpu)?,
            blend: plain.stage(gpu)?,
        })
    }
}

buffer_set! {
    /// Views and their pictures.
    pub struct BlendBuffers {
        /// [`crate::kernels::layout::GaussianSetup`].
        gaussian_setup,
        /// [`BlendSetup`].
        blend_setup,
        /// [`crate::kernels::layout::GaussianView`] of each image.
        gaussian_views,
        /// `[iteration][set]`: [`crate::kernels::layout::PictureTurn`]s.
        picture_turns,
        /// Iterations done.
        gaussian_step,
        /// `[set][tile row][tile column]`: Gaussians that may show.
        blend_tile_counts,
        /// [`crate::kernels::layout::BlendCounts`].
        blend_counts,
        /// `[set][tile row][tile column]`: [`crate::kernels::layout::BlendList`]s.
        blend_lists,
        /// `[set][pixel]`: pictures in fixed point.
        splat_images,
        /// `[set][pixel]`: [`crate::kernels::layout::BlendEnd`]s.
        blend_ends,
    }
}

/// A recording of pictures of `n` Gaussians.
pub struct BlendPass<'a> {
    /// Recording that the stages are added to.
    pub recording: &'a mut Recording,
    /// The stages.
    pub kernels: &'a BlendKernels,
    /// Views and pictures.
    pub scene: &'a BlendBuffers,
    /// The Gaussians.
    pub seen: &'a BlendedGaussians,
    /// Constants on the host.
    pub x: &'a BlendSetup,
    /// Number of Gaussians of all sets.
    pub n: u32,
}

/// A workgroup per tile of all pictures.
pub fn tiles(x: &BlendSetup) -> Groups<'static> {
    Groups::Direct([x.tile_columns, x.tile_rows, x.n_sets])
}

impl BlendPass<'_> {
    fn run<P: PushConstants>(
        &mut self,
        stage: &Stage<P>,
        groups: Groups<'_>,
        keys: [Binding; 2],
        push: P,
    ) -> Result<()> {
        let (scene, seen) = (self.scene, self.seen);
        let find = |name| scene.find(name).or_else(|| seen.find(name));
        let (from, to) = if keys[0] == Binding::blend_keys {
            (&seen.blend_keys, &seen.blend_keys_moved)
        } else {
            (&seen.blend_keys_moved, &seen.blend_keys)
        };
        let bound = [(Binding::blend_keys, from.into()), (Binding::blend_keys_moved, to.into())];
        dispatch_finding(self.recording, stage, groups, &bound, find, push)
    }

    /// Records the pictures that the views of this iteration take.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
    pub fn record(&mut self) -> Result<()> {
        let (kernels, n, n_sets) = (self.kernels, self.n, self.x.n_sets);
        let mut keys = [Binding::blend_keys, Binding::blend_keys_moved];
        self.recording.fill(&self.scene.blend_tile_counts, 0);
        self.recording.fill(&self.scene.blend_counts, 0);
        let push = push::BlendProject { n_gaussians: n };
        self.run(&kernels.project, kernels.project.groups_over(n), keys, push)?;
        let n_blocks = sort_blocks(n);
        for pass in 0..sort_passes(n_sets) {
            let shift = BITS_OF_PASS * pass;
            let push = push::BlendSortCount { n_keys: n, n_blocks, shift };
            self.run(&kernels.sort_count, along_two_axes(n_blocks), keys, push)?;
            let push = push::BlendSortScan { n_counts: DIGITS * n_blocks };
            self.run(&kernels.sort_scan, Groups::Direct([1, 1, 1]), keys, push)?;
            let push = push::BlendSortMove { n_keys: n, n_blocks, shift };
            self.run(&kernels.sort_move, along_two_axes(n_blocks), keys, push)?;
            keys.reverse();
        }
        self.run(&kernels.lists, tiles(self.x), keys, push::BlendLists {})?;
        self.run(&kernels.blend, tiles(self.x), keys, push::BlendPicture {})
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
