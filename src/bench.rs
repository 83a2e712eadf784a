//! Measurements: [`peaks`] of the device, its [`sensors`] meanwhile; [`crate::train::timing`] has those of training.

pub mod peaks;
pub mod sensors;

/// Seconds the paper needs for a reconstruction on an RTX A5000 (section 4: 37 minutes).
pub const PAPER_SECONDS: f64 = 37.0 * 60.0;
