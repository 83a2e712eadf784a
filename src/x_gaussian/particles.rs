//! Gaussians of X-Gaussian on the device: data for pictures, and data for the fit.

use crate::error::Result;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::kernels::dispatch::{Binding, buffer_set};
use crate::kernels::layout::{Splat, XGaussian, XKey, XSet, XSpan};
use crate::model::x_gaussian::XState;
use crate::x_gaussian::stages::{SUMS, sort_blocks};

/// Values of the four bits that a pass sorts by.
const DIGITS: u64 = 16;

buffer_set! {
    /// Gaussians, how they are seen, and their order.
    pub struct XSeenBuffers {
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

impl XSeenBuffers {
    /// Puts Gaussians of `n_sets` sets on the device, and lists with room for `capacity`.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn new(gpu: &Gpu, rows: &[XGaussian], sets: &[u32], n_sets: usize, capacity: u32) -> Result<XSeenBuffers> {
        let n = rows.len() as u64;
        let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
        let mut places = vec![XSet::default(); n_sets];
        sets.iter().for_each(|set| places[*set as usize].count += 1);
        for set in 1..n_sets {
            places[set].first = places[set - 1].first + places[set - 1].count;
        }
        Ok(XSeenBuffers {
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
    /// As [`XSeenBuffers::new`].
    pub fn make_room(&mut self, gpu: &Gpu, capacity: u32) -> Result<()> {
        self.x_list_items = lists(gpu, capacity)?;
        Ok(())
    }
}

fn lists(gpu: &Gpu, capacity: u32) -> Result<Buffer> {
    gpu.buffer(Binding::x_list_items.name(), 4 * u64::from(capacity), Memory::Device)
}

buffer_set! {
    /// State of the optimiser and statistics of each Gaussian.
    pub struct XLearningBuffers {
        /// First moments of Adam, three vec4 per Gaussian: position and opacity, scale and intensity, rotation.
        gaussian_adam_first,
        /// Second moments of Adam, laid out alike.
        gaussian_adam_second,
        /// Gradient, laid out alike.
        gaussian_gradient,
        /// [`crate::kernels::layout::XStatistics`].
        x_statistics,
        /// `[entry][sum]`: sums over tiles, for gradients.
        x_entries,
    }
}

impl XLearningBuffers {
    /// Puts a state on the device, and room for the gradients of `capacity` Gaussians in all tiles' lists.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn new(gpu: &Gpu, state: &XState, capacity: u32) -> Result<XLearningBuffers> {
        let n = state.rows.len() as u64;
        Ok(XLearningBuffers {
            gaussian_adam_first: gpu.buffer_with("gaussian_adam_first", &state.first)?,
            gaussian_adam_second: gpu.buffer_with("gaussian_adam_second", &state.second)?,
            gaussian_gradient: gpu.buffer(Binding::gaussian_gradient.name(), 48 * n, Memory::Device)?,
            x_statistics: gpu.buffer_with("x_statistics", &state.statistics)?,
            x_entries: entries(gpu, capacity)?,
        })
    }

    /// Makes room for the gradients of `capacity` Gaussians in lists.
    ///
    /// # Errors
    /// As [`XLearningBuffers::new`].
    pub fn make_room(&mut self, gpu: &Gpu, capacity: u32) -> Result<()> {
        self.x_entries = entries(gpu, capacity)?;
        Ok(())
    }
}

fn entries(gpu: &Gpu, capacity: u32) -> Result<Buffer> {
    gpu.buffer(Binding::x_entries.name(), 4 * u64::from(SUMS) * u64::from(capacity), Memory::Device)
}

/// Reads the state of Gaussians back, whose sets are known.
///
/// # Errors
/// Device errors.
pub fn download(gpu: &Gpu, seen: &XSeenBuffers, learning: &XLearningBuffers, sets: &[u32]) -> Result<XState> {
    let n = sets.len();
    Ok(XState {
        rows: gpu.download(&seen.x_gaussians, 0, n)?,
        sets: sets.to_vec(),
        first: gpu.download(&learning.gaussian_adam_first, 0, n)?,
        second: gpu.download(&learning.gaussian_adam_second, 0, n)?,
        statistics: gpu.download(&learning.x_statistics, 0, n)?,
    })
}
