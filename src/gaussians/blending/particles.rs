//! Gaussians of which nearer ones hide those behind them, on the device.

use crate::error::Result;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::kernels::dispatch::{Binding, buffer_set};
use crate::kernels::layout::{BlendGaussian, BlendKey, BlendSet, BlendSpan, Splat};
use crate::kernels::push::{self, PushConstants};

/// Number of keys of a block of the sort.
const KEYS_OF_BLOCK: u32 = 16 * push::BlendSortCount::LOCAL_SIZE;
const _: () = assert!(push::BlendSortMove::LOCAL_SIZE == push::BlendSortCount::LOCAL_SIZE);
/// Blocks of the sort of `n` keys.
pub fn sort_blocks(n: u32) -> u32 {
    n.div_ceil(KEYS_OF_BLOCK)
}

/// Values of the four bits that a pass sorts by.
const DIGITS: u64 = 16;

buffer_set! {
    /// Gaussians, how they are seen, and their order.
    pub struct BlendedGaussians {
        /// [`BlendGaussian`]s.
        blend_gaussians,
        /// The set of each.
        blend_set_of,
        /// [`BlendSet`]s.
        blend_sets,
        /// [`Splat`]s.
        splats,
        /// [`BlendSpan`]s.
        blend_spans,
        /// [`BlendKey`]s.
        blend_keys,
        /// [`BlendKey`]s that a pass of the sort writes.
        blend_keys_moved,
        /// `[digit][block]`: counts of the sort.
        blend_sort_counts,
        /// Gaussians in the lists of all tiles.
        blend_list_items,
    }
}

impl BlendedGaussians {
    /// Puts Gaussians of `n_sets` sets on the device, and lists with room for `capacity`.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn new(
        gpu: &Gpu,
        rows: &[BlendGaussian],
        sets: &[u32],
        n_sets: usize,
        capacity: u32,
    ) -> Result<BlendedGaussians> {
        let n = rows.len() as u64;
        let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
        let mut places = vec![BlendSet::default(); n_sets];
        sets.iter().for_each(|set| places[*set as usize].count += 1);
        for set in 1..n_sets {
            places[set].first = places[set - 1].first + places[set - 1].count;
        }
        Ok(BlendedGaussians {
            blend_gaussians: gpu.buffer_with("blend_gaussians", rows)?,
            blend_set_of: gpu.buffer_with("blend_set_of", sets)?,
            blend_sets: gpu.buffer_with("blend_sets", &places)?,
            splats: new(Binding::splats, size_of::<Splat>() as u64 * n)?,
            blend_spans: new(Binding::blend_spans, size_of::<BlendSpan>() as u64 * n)?,
            blend_keys: new(Binding::blend_keys, size_of::<BlendKey>() as u64 * n)?,
            blend_keys_moved: new(Binding::blend_keys_moved, size_of::<BlendKey>() as u64 * n)?,
            blend_sort_counts: new(Binding::blend_sort_counts, 4 * DIGITS * u64::from(sort_blocks(rows.len() as u32)))?,
            blend_list_items: lists(gpu, capacity)?,
        })
    }

    /// Gives lists room for `capacity` Gaussians.
    ///
    /// # Errors
    /// As [`BlendedGaussians::new`].
    pub fn make_room(&mut self, gpu: &Gpu, capacity: u32) -> Result<()> {
        self.blend_list_items = lists(gpu, capacity)?;
        Ok(())
    }
}

fn lists(gpu: &Gpu, capacity: u32) -> Result<Buffer> {
    Ok(gpu.buffer(Binding::blend_list_items.name(), 4 * u64::from(capacity), Memory::Device)?)
}
