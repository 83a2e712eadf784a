//! Losses of an iteration, and the detection of divergence.

use crate::config::Config;
use crate::error::{Error, Result};
use crate::kernels::layout::StepReport;
use serde::Serialize;

/// Losses of one iteration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StepLoss {
    /// Number of iterations done after this one.
    pub step: u32,
    /// Weighted data terms.
    pub data: f64,
    /// Weighted data term of the dynamic field alone.
    pub dynamic: f64,
    /// Total variation, weighted.
    pub tv: f64,
    /// Occlusion loss, weighted.
    pub occlusion: f64,
    /// Mean squared residual of the total line integral; not a number while Gaussians are fitted.
    pub squared_error: f64,
    /// Dynamic samples of the batch that were evaluated.
    pub live_samples: u64,
    /// Factor on gradients in f16; 1 on the f32 path.
    pub loss_scale: f64,
    /// Additional losses of two networks.
    #[serde(flatten)]
    pub networks: Option<NetworkLosses>,
}

/// Additional losses of two networks.
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
    pub(crate) fn of(report: &StepReport) -> NetworkLosses {
        NetworkLosses {
            favour_static: report.favour_static.into(),
            ray_entropy: report.ray_entropy.into(),
            static_size: report.static_size.into(),
            stopped: report.stopped != 0,
        }
    }

    /// Returns the contribution of these losses to the objective.
    fn total(&self) -> f64 {
        self.favour_static + self.ray_entropy + self.static_size
    }
}

impl StepLoss {
    /// Returns the losses of an iteration on Gaussians, which are fitted to bounds of line integrals.
    pub(crate) fn of_gaussians(step: u32, loss: f64) -> StepLoss {
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

    /// Returns the losses of an iteration on whole images, whose line integrals are in units of `attenuation`.
    pub(crate) fn of_images(step: u32, loss: f64, attenuation: f64) -> StepLoss {
        StepLoss { squared_error: loss * attenuation * attenuation, ..StepLoss::of_gaussians(step, loss) }
    }

    /// Returns the objective.
    pub fn total(&self) -> f64 {
        self.data + self.tv + self.occlusion + self.networks.map_or(0.0, |networks| networks.total())
    }
}

/// Multiple of the first loss at which a warning is issued. At the published rates of NerT-CA, losses grow by a factor of 1e7 and more
/// (docs/methods/nert-ca.md).
const LARGE: f64 = 1e6;
/// Settings that make the steps of a static tensor field smaller.
pub(crate) const SMALLER_STEPS: &str = "a lower static.lr";
/// Settings that make the steps of ray-marched fields smaller where the dynamic one is a network.
pub(crate) const SMALLER_STEPS_WITH_A_NETWORK: &str = "a lower static.lr or dynamic.lr";

/// A loss far above the first one. With the published learning rates, such a loss occurs when the dynamic field starts, and
/// training continues.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LargeLoss {
    /// Number of iterations done after this one.
    pub step: u32,
    /// The loss.
    pub loss: f64,
    /// The loss divided by the first loss after this start.
    pub ratio: f64,
}

impl std::fmt::Display for LargeLoss {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let LargeLoss { step, loss, ratio } = self;
        write!(
            f,
            "the loss of iteration {step} is {loss:.3e}, {ratio:.0e} times the first loss; training continues (set \
             train.stop_at_loss_ratio to end it at such a loss)"
        )
    }
}

/// Checks the losses of a run for those that end it and for the first large one.
pub(crate) struct LossWatch {
    stop_at_ratio: f64,
    advice: &'static str,
    first: Option<f64>,
    has_warned: bool,
}

impl LossWatch {
    /// Creates the check for a run that ends at a loss of `train.stop_at_loss_ratio` times the first one; 0: only at a loss
    /// that is not finite. `advice` names settings that make the steps of the run smaller.
    pub(crate) fn new(config: &Config, advice: &'static str) -> LossWatch {
        LossWatch { stop_at_ratio: config.train.stop_at_loss_ratio, advice, first: None, has_warned: false }
    }

    /// Checks the next loss; returns it if it is the first large one.
    ///
    /// # Errors
    /// [`Error::Diverged`] for a loss that is not finite, or at which the run is to end.
    pub(crate) fn see(&mut self, loss: &StepLoss) -> Result<Option<LargeLoss>> {
        let value = loss.total();
        let ratio = value / self.first.get_or_insert(value).max(1e-12);
        if !value.is_finite() || (self.stop_at_ratio > 0.0 && ratio > self.stop_at_ratio) {
            let (step, quantity) = (u64::from(loss.step), "loss");
            return Err(Error::Diverged { step, quantity, value, advice: self.advice });
        }
        if ratio <= LARGE || self.has_warned {
            return Ok(None);
        }
        self.has_warned = true;
        Ok(Some(LargeLoss { step: loss.step, loss: value, ratio }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

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

    #[test]
    fn large_losses_are_warned_of_once_and_end_a_run_only_where_that_is_set() {
        let loss = |step, data| StepLoss { tv: 0.0, ..StepLoss::of_gaussians(step, data) };
        let mut config = Config::preset(Preset::Paper);
        let mut watch = LossWatch::new(&config, SMALLER_STEPS);
        assert_eq!(watch.see(&loss(1, 2e-3)).unwrap(), None);
        assert_eq!(watch.see(&loss(2, 1e3)).unwrap(), None);
        let warned = watch.see(&loss(3, 4e3)).unwrap().unwrap();
        assert_eq!((warned.step, warned.loss), (3, 4e3));
        assert!(warned.to_string().contains("iteration 3") && warned.to_string().contains("2e6 times"), "{warned}");
        assert_eq!(watch.see(&loss(4, 8e30)).unwrap(), None, "once");
        assert!(matches!(watch.see(&loss(5, f64::INFINITY)), Err(Error::Diverged { step: 5, .. })));

        config.train.stop_at_loss_ratio = 100.0;
        let mut watch = LossWatch::new(&config, SMALLER_STEPS);
        assert_eq!(watch.see(&loss(1, 1.0)).unwrap(), None);
        assert_eq!(watch.see(&loss(2, 99.0)).unwrap(), None);
        assert!(matches!(watch.see(&loss(3, 101.0)), Err(Error::Diverged { step: 3, .. })));
    }
}
