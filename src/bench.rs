//! Measurements of a device: its [`peaks`], and [`crate::gpu::sensors`] during a measurement. [`crate::train::timing`] times
//! training.

pub mod peaks;

/// Seconds the paper needs for a reconstruction on an RTX A5000 (section 4: 37 minutes).
pub const PAPER_SECONDS: f64 = 37.0 * 60.0;
