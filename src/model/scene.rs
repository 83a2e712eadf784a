//! How numbers are scaled and where the fields live.

use serde::{Deserialize, Serialize};

/// How numbers are scaled and where fields live; kept in checkpoints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// Lower corner of the static field's box, world units.
    pub static_min: [f64; 3],
    /// Upper corner.
    pub static_max: [f64; 3],
    /// Lower corner of the dynamic field's box.
    pub dynamic_min: [f64; 3],
    /// Upper corner.
    pub dynamic_max: [f64; 3],
    /// Depth range of the static field around the isocentre plane.
    pub static_depth: [f64; 2],
    /// Depth range of the dynamic field.
    pub dynamic_depth: [f64; 2],
    /// Centre of the network's input: an encoded coordinate is (x - centre) * scale.
    pub encode_centre: [f64; 3],
    /// Scale of the network's input: an encoded coordinate is (x - centre) * scale.
    pub encode_scale: f64,
    /// Gain of the static field: sigma_l = gain * softplus(feature + shift), per world unit.
    pub static_gain: f64,
    /// Shift of the static field: sigma_l = gain * softplus(feature + shift).
    pub static_shift: f64,
    /// Gain of the dynamic field: sigma_s = gain * softplus(feature + shift), per world unit.
    pub dynamic_gain: f64,
    /// Shift of the dynamic field: sigma_s = gain * softplus(feature + shift).
    pub dynamic_shift: f64,
    /// Weight of a squared residual of the static field.
    pub static_weight: f64,
    /// Weight of a squared residual of the dynamic field.
    pub dynamic_weight: f64,
    /// Residual of the dynamic field from which the loss grows linearly; 0 = never.
    pub robust_scale: f64,
}
