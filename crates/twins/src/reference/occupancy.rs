//! Reference implementation (twin) of the occupancy learned during training.

use crate::kernels::constants::{CELLS_PER_WORD, OCCUPANCY_EPOCH, OCCUPANCY_EPOCHS, OCCUPIED, SEEN};
use crate::kernels::layout::Setup;
use crate::random::{STREAM_OCCUPANCY, pcg4d};
use crate::reference::field::point;
use glam::DVec3;

/// Share of a phase below which an empty sample is no evidence for it, as in `occupancy_mark`.
pub const LITTLE_SHOWN: f32 = 0.25;

/// Index of a cell's entry of two bits.
pub fn entry(s: &Setup, x: DVec3, phase: u32) -> u32 {
    let (low, high) = (point(s.dynamic_min), point(s.dynamic_max));
    let n = s.occupancy_cells;
    let cell = ((x - low) / (high - low) * f64::from(n)).max(DVec3::ZERO).to_array().map(|c| (c as u32).min(n - 1));
    ((phase * n + cell[2]) * n + cell[1]) * n + cell[0]
}

/// Tells whether a sample is evaluated at a step, given the words of all epochs (twin of `occupied`).
pub fn occupied(s: &Setup, occupancy: &[u32], x: DVec3, phase: u32, step: u32) -> bool {
    if s.occupancy_cells == 0 || step < s.occupancy_start {
        return true;
    }
    let entry = entry(s, x, phase);
    let epoch = step / OCCUPANCY_EPOCH;
    let word = |epoch: u32| {
        occupancy[(epoch % OCCUPANCY_EPOCHS) as usize * s.occupancy_words() + (entry / CELLS_PER_WORD) as usize]
    };
    let bits = (word(epoch) | word(epoch + OCCUPANCY_EPOCHS - 1)) >> (2 * (entry % CELLS_PER_WORD));
    bits & SEEN == 0 || bits & OCCUPIED != 0 || pcg4d([s.seed, STREAM_OCCUPANCY, step, entry])[0] & 7 == 0
}
