//! Hyper-parameters of the tree, beside those of its Gaussians. Lengths are pixels at the isocentre.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How one set of Gaussians is made to move.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TreeSettings {
    /// Iterations of phase 0 alone, before anything moves.
    pub warm_iterations: u32,
    /// Amplitude from which a Gaussian of phase 0 is taken into the tree.
    pub take: f64,
    /// Distance of the grid's nodes.
    pub node: f64,
    /// Adam's rate of displacements.
    pub grid_rate: f64,
    /// Penalty on squared differences of neighbouring nodes.
    pub smoothness: f64,
    /// Harmonics of a Gaussian's own motion.
    pub harmonics: u32,
    /// Adam's rate of own motion.
    pub own_rate: f64,
    /// Penalty on squared own motion.
    pub own_penalty: f64,
    /// Blur of images and Gaussians while the grid is tracked.
    pub track_blur: f64,
    /// Adam's rate of displacements while they are tracked.
    pub track_rate: f64,
    /// Iterations per tracked phase.
    pub track_iterations: u32,
}

impl Default for TreeSettings {
    fn default() -> TreeSettings {
        TreeSettings {
            warm_iterations: 60,
            take: 0.03,
            node: 18.0,
            grid_rate: 0.03,
            smoothness: 0.002,
            harmonics: 4,
            own_rate: 0.02,
            own_penalty: 0.3,
            track_blur: 1.5,
            track_rate: 0.25,
            track_iterations: 25,
        }
    }
}
