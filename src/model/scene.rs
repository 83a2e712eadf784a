//! Scales and boxes of the fields.

use crate::model::component::Component;
use serde::{Deserialize, Serialize};

/// Scales and boxes of the fields; kept in checkpoints.
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
    /// Lower and upper corner of the region of interest, world units, where the fields' boxes contain much more than views see,
    /// as those of two networks do; none where the region is the boxes, and in older checkpoints.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub region: Option<[[f64; 3]; 2]>,
    /// Whether the object is at rest: phase 0 shows it, and phase 1 is the same without vessels (see
    /// [`crate::scan::dataset::Dataset::still`]).
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub still: bool,
}

impl Scene {
    /// Returns the lower and upper corner of the region of interest of a component's fields, as for vessels and exports, world
    /// units.
    pub fn region_of(&self, component: Component) -> [[f64; 3]; 2] {
        self.region.unwrap_or(match component {
            Component::Dynamic => [self.dynamic_min, self.dynamic_max],
            Component::Total | Component::Static => [self.static_min, self.static_max],
        })
    }
}
