//! Code that the fits of all methods share: traits of fits and fields, recorded iterations, losses, sets of static methods. It depends on no method.

pub(crate) mod extent;
pub mod fit;
pub(crate) mod iterations;
pub mod ledger;
pub mod losses;
pub(crate) mod ring;
pub mod sets;
pub mod shown;

/// Iterations whose losses the device keeps for the host.
pub const RING_LENGTH: u32 = 1024;
/// Fractional bits of the static gradient's 64-bit sums, which resolve 1e-15 and hold +-8192.
pub const FIXED_POINT_BITS: u32 = 50;
