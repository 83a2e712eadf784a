//! Settings of a calibration.

use serde::{Deserialize, Serialize};
use strum::{IntoStaticStr, VariantArray};

/// Corrections of the views' stated geometry.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum CalibrateMode {
    /// The mode that best predicts phases left out of the calibration: none, static, or breathing.
    Auto,
    /// No correction.
    #[default]
    Off,
    /// Angles and position of each view, where this improves the agreement.
    Static,
    /// Angles and position of each view and a displacement of the heart in each frame, where this improves the agreement.
    Breathing,
}

/// Settings of a calibration.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CalibrateSettings {
    /// Corrections to be estimated.
    pub mode: CalibrateMode,
    /// Whether the field that is fitted afterwards supports a displacement of the heart in each frame.
    pub follows_breath: bool,
}
