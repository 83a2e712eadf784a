//! How numbers are scaled and where the fields live.

use crate::model::component::Component;
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
    /// Lower and upper corner of where the fields are looked at, world units, where their boxes hold much more than views see, as
    /// those of two networks do; none where the boxes are it, and in checkpoints of before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub region: Option<[[f64; 3]; 2]>,
}

impl Scene {
    /// Lower and upper corner of where the fields of a component are looked at, as for vessels and exports, world units.
    pub fn region_of(&self, component: Component) -> [[f64; 3]; 2] {
        self.region.unwrap_or(match component {
            Component::Dynamic => [self.dynamic_min, self.dynamic_max],
            Component::Total | Component::Static => [self.static_min, self.static_max],
        })
    }
}
