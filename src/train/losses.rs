//! What an iteration tells of itself.

use crate::kernels::layout::StepReport;
use serde::Serialize;

/// Losses of one iteration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StepLoss {
    /// Iterations done after it.
    pub step: u32,
    /// Weighted data terms.
    pub data: f64,
    /// Weighted data term of the dynamic field alone.
    pub dynamic: f64,
    /// Total variation, weighted.
    pub tv: f64,
    /// Occlusion, weighted.
    pub occlusion: f64,
    /// Mean squared residual of the total line integral; not a number while Gaussians are fitted.
    pub squared_error: f64,
    /// Live dynamic samples of the batch.
    pub live_samples: u64,
    /// Factor on gradients in f16; 1 on the f32 path.
    pub loss_scale: f64,
    /// Losses that two networks have beside these.
    #[serde(flatten)]
    pub networks: Option<NetworkLosses>,
}

/// Losses of two networks beside those of every run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct NetworkLosses {
    /// Entropy of the fields' shares at samples, weighted.
    pub favour_static: f64,
    /// Entropy of the dynamic field along rays, weighted.
    pub ray_entropy: f64,
    /// The static field's integrals over intervals and their squares, weighted.
    pub static_size: f64,
    /// Whether an entropy has vanished and learning ended.
    pub stopped: bool,
}

impl NetworkLosses {
    pub(super) fn of(report: &StepReport) -> NetworkLosses {
        NetworkLosses {
            favour_static: report.favour_static.into(),
            ray_entropy: report.ray_entropy.into(),
            static_size: report.static_size.into(),
            stopped: report.stopped != 0,
        }
    }

    /// What they add to the objective.
    fn total(&self) -> f64 {
        self.favour_static + self.ray_entropy + self.static_size
    }
}

impl StepLoss {
    /// An iteration of Gaussians, which are fitted to bounds and not to line integrals.
    pub(super) fn of_gaussians(step: u32, loss: f64) -> StepLoss {
        let none = StepLoss {
            step,
            data: 0.0,
            dynamic: 0.0,
            tv: 0.0,
            occlusion: 0.0,
            squared_error: f64::NAN,
            live_samples: 0,
            loss_scale: 1.0,
            networks: None,
        };
        StepLoss { data: loss, dynamic: loss, ..none }
    }

    /// An iteration of SAX-NeRF, whose line integrals are in units of `attenuation`.
    pub(super) fn of_sax(step: u32, loss: f64, attenuation: f64) -> StepLoss {
        StepLoss { squared_error: loss * attenuation * attenuation, ..StepLoss::of_gaussians(step, loss) }
    }

    /// The objective.
    pub fn total(&self) -> f64 {
        self.data + self.tv + self.occlusion + self.networks.map_or(0.0, |networks| networks.total())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_objective_counts_each_term_once() {
        let loss = StepLoss {
            step: 1,
            data: 1.0,
            // Part of `data`, and an error that is not weighted.
            dynamic: 0.25,
            tv: 0.125,
            occlusion: 0.5,
            squared_error: 7.0,
            live_samples: 3,
            loss_scale: 1.0,
            networks: None,
        };
        assert_eq!(loss.total(), 1.625);
        let networks = NetworkLosses { favour_static: 2.0, ray_entropy: 4.0, static_size: 8.0, stopped: false };
        assert_eq!(StepLoss { networks: Some(networks), ..loss }.total(), 15.625);
    }
}
