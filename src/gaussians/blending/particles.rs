//! Gaussians of which nearer ones hide those behind them, on the device.

use crate::error::Result;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::kernels::dispatch::{Binding, buffer_set};
use crate::kernels::layout::{Splat, XGaussian, XKey, XSet, XSpan};
use crate::kernels::push::{self, PushConstants};

/// Number of keys of a block of the sort.
const KEYS_OF_BLOCK: u32 = 16 * push::XSortCount::LOCAL_SIZE;
const _: () = assert!(push::XSortMove::LOCAL_SIZE == push::XSortCount::LOCAL_SIZE);
/// Blocks of the sort of `n` keys.
pub fn sort_blocks(n: u32) -> u32 {
    n.div_ceil(KEYS_OF_BLOCK)
}

/// Values of the four bits that a pass sorts by.
const DIGITS: u64 = 16;

buffer_set! {
    /// Gaussians, how they are seen, and their order.
    pub struct BlendedGaussians {
        /// [`XGaussian`]s.
        x_gaussians,
        /// The set of each.
        x_set_of,
        /// [`XSet`]s.
        x_sets,
        /// [`Splat`]s.
        splats,
        /// [`XSpan`]s.
        x_spans,
        /// [`XKey`]s.
        x_keys,
        /// [`XKey`]s that a pass of the sort writes.
        x_keys_moved,
        /// `[digit][block]`: counts of the sort.
        x_sort_counts,
        /// Gaussians in the lists of all tiles.
        x_list_items,
    }
}

impl BlendedGaussians {
    /// Puts Gaussians of `n_sets` sets on the device, and lists with room for `capacity`.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn new(gpu: &Gpu, rows: &[XGaussian], sets: &[u32], n_sets: usize, capacity: u32) -> Result<BlendedGaussians> {
        let n = rows.len() as u64;
        let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
        let mut places = vec![XSet::default(); n_sets];
        sets.iter().for_each(|set| places[*set as usize].count += 1);
        for set in 1..n_sets {
            places[set].first = places[set - 1].first + places[set - 1].count;
        }
        Ok(BlendedGaussians {
            x_gaussians: gpu.buffer_with("x_gaussians", rows)?,
            x_set_of: gpu.buffer_with("x_set_of", sets)?,
            x_sets: gpu.buffer_with("x_sets", &places)?,
            splats: new(Binding::splats, size_of::<Splat>() as u64 * n)?,
            x_spans: new(Binding::x_spans, size_of::<XSpan>() as u64 * n)?,
            x_keys: new(Binding::x_keys, size_of::<XKey>() as u64 * n)?,
            x_keys_moved: new(Binding::x_keys_moved, size_of::<XKey>() as u64 * n)?,
            x_sort_counts: new(Binding::x_sort_counts, 4 * DIGITS * u64::from(sort_blocks(rows.len() as u32)))?,
            x_list_items: lists(gpu, capacity)?,
        })
    }

    /// Gives lists room for `capacity` Gaussians.
    ///
    /// # Errors
    /// As [`BlendedGaussians::new`].
    pub fn make_room(&mut self, gpu: &Gpu, capacity: u32) -> Result<()> {
        self.x_list_items = lists(gpu, capacity)?;
        Ok(())
    }
}

fn lists(gpu: &Gpu, capacity: u32) -> Result<Buffer> {
    Ok(gpu.buffer(Binding::x_list_items.name(), 4 * u64::from(capacity), Memory::Device)?)
}
