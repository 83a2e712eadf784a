//! Operations that the network costs.

use crate::model::params::ParamMap;
use serde::{Deserialize, Serialize};

/// Operations of the network per sample, a multiply-add counted as two.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct NetworkCost {
    /// Forward.
    pub forward: u64,
    /// Gradient of the weights.
    pub weights: u64,
    /// Gradient of hidden inputs.
    pub inputs: u64,
}

impl NetworkCost {
    /// Counts, without padding and without biases and latents, which cost one row per phase.
    pub fn of(params: &ParamMap) -> NetworkCost {
        let width = params.width as u64;
        let mut forward = width;
        let mut inputs = width;
        for layer in &params.layers {
            forward += layer.encoded.map_or(0, |_| width * params.encoded_len as u64);
            forward += layer.hidden.map_or(0, |_| width * width);
            inputs += layer.hidden.map_or(0, |_| width * width);
        }
        NetworkCost { forward: 2 * forward, weights: 2 * forward, inputs: 2 * inputs }
    }

    /// All three.
    pub fn total(&self) -> u64 {
        self.forward + self.weights + self.inputs
    }
}
