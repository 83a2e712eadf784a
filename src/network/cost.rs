//! Number of operations of the networks.

use crate::model::params::{NetworkMap, ParamMap};
use serde::{Deserialize, Serialize};

/// Operations of the networks per sample, a multiply-add counted as two.
#[derive(Debug, Clone, Copy, Default, Serialize, Deserialize)]
pub struct NetworkCost {
    /// Forward pass.
    pub forward: u64,
    /// Weight gradients.
    pub weights: u64,
    /// Gradients of hidden inputs.
    pub inputs: u64,
}

impl NetworkCost {
    /// Counts all networks, without padding, and without biases and latents, which cost only one row per phase.
    pub fn of(params: &ParamMap) -> NetworkCost {
        params.networks().map(NetworkCost::of_network).fold(NetworkCost::default(), |a, b| NetworkCost {
            forward: a.forward + b.forward,
            weights: a.weights + b.weights,
            inputs: a.inputs + b.inputs,
        })
    }

    fn of_network(params: &NetworkMap) -> NetworkCost {
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

    /// Sum of all three.
    pub fn total(&self) -> u64 {
        self.forward + self.weights + self.inputs
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Preset};

    #[test]
    fn both_networks_of_nerf_ca_count() {
        let cost = NetworkCost::of(&ParamMap::new(&Config::preset(Preset::NerfCa), 10));
        // The product has 75 inputs, four hidden layers and an output, in each of two networks; latents are rows per phase.
        let forward = 2 * 2 * (128 * 75 + 4 * 128 * 128 + 128);
        assert_eq!((cost.forward, cost.weights), (forward, forward));
        assert_eq!(cost.inputs, 2 * 2 * (4 * 128 * 128 + 128));
    }
}
