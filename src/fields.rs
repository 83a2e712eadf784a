//! Static and dynamic fields that rays are marched through: NerT-CA, NeRF-CA, and the static field behind Gaussians.
//!
//! 1. [`motion`] finds in each view where something moves, [`carve`] a motion hull from it, [`scale`] boxes and scales
//! 2. [`data`] collects everything that a fit needs in the device's terms
//! 3. [`step`] is one iteration from top to bottom, [`trainer`] many of them
//! 4. [`state`] is the fit as a checkpoint keeps it, and its tensors

pub mod carve;
pub mod data;
pub mod images;
pub mod motion;
pub mod scale;
mod schedule;
pub mod setup;
pub mod start;
pub mod state;
pub mod step;
pub mod trainer;
