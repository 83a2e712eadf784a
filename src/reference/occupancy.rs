//! Twin of the occupancy learned while training.

use crate::kernels::layout::{OCCUPANCY_EPOCH, Setup};
use crate::random::{STREAM_OCCUPANCY, pcg4d};
use glam::DVec3;

/// A sample was evaluated in the cell.
pub const SEEN: u32 = 1;
/// One was not empty.
pub const OCCUPIED: u32 = 2;

/// Position of a cell's two bits.
pub fn entry(s: &Setup, x: DVec3, phase: u32) -> u32 {
    let low = DVec3::new(s.dynamic_min_x.into(), s.dynamic_min_y.into(), s.dynamic_min_z.into());
    let high = DVec3::new(s.dynamic_max_x.into(), s.dynamic_max_y.into(), s.dynamic_max_z.into());
    let n = s.occupancy_cells;
    let cell = ((x - low) / (high - low) * f64::from(n)).max(DVec3::ZERO).to_array().map(|c| (c as u32).min(n - 1));
    ((phase * n + cell[2]) * n + cell[1]) * n + cell[0]
}

/// Whether a sample is evaluated at a step, given all epochs' words (twin of `occupied`).
pub fn occupied(s: &Setup, occupancy: &[u32], x: DVec3, phase: u32, step: u32) -> bool {
    if s.occupancy_cells == 0 || step < s.occupancy_start {
        return true;
    }
    let entry = entry(s, x, phase);
    let epoch = (step / OCCUPANCY_EPOCH) as usize;
    let word = |e: usize| occupancy[e % 3 * s.occupancy_words() + entry as usize / 16];
    let bits = (word(epoch) | word(epoch + 2)) >> (2 * (entry % 16));
    bits & SEEN == 0 || bits & OCCUPIED != 0 || pcg4d([s.seed, STREAM_OCCUPANCY, step, entry])[0] & 7 == 0
}
