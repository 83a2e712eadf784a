//! Hyper-parameters of the Gaussians. Lengths are pixels at the isocentre, amplitudes shares of the strongest change.

use crate::error::{Error, Result};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// How Gaussians are seeded and fitted.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Seed of all random choices.
    pub seed: u32,
    /// Iterations, each over all images.
    pub iterations: u32,
    /// Gaussians seeded per phase.
    pub count: u32,
    /// First scale.
    pub first_scale: f64,
    /// Least scale.
    pub least_scale: f64,
    /// Greatest scale.
    pub greatest_scale: f64,
    /// Adam's rate of positions.
    pub position_rate: f64,
    /// Adam's rate of log-scales.
    pub scale_rate: f64,
    /// Adam's rate of quaternions.
    pub rotation_rate: f64,
    /// Adam's rate of log-densities.
    pub density_rate: f64,
    /// Share of the iterations, at the end, over which rates fall.
    pub fall_share: f64,
    /// What rates fall to.
    pub last_rate: f64,
    /// Where the loss bends from square to linear.
    pub bend: f64,
    /// Noise at which a pixel counts 0.7 times; 0 = all pixels count alike.
    pub noise_scale: f64,
    /// Standard deviations at which a Gaussian ends.
    pub cut: f64,
    /// Iteration at which weak Gaussians are dropped and new ones placed where data are missing; 0 = never.
    pub grow_at: u32,
    /// New Gaussians per phase, as a share of `count`.
    pub grow_share: f64,
    /// Amplitude below which a Gaussian is dropped.
    pub weakest: f64,
    /// Missing line integral from which a Gaussian is placed; also its first density.
    pub missing: f64,
}

impl Default for Settings {
    fn default() -> Settings {
        Settings {
            seed: 0,
            iterations: 100,
            count: 500,
            first_scale: 0.8,
            least_scale: 0.4,
            greatest_scale: 3.0,
            position_rate: 0.05,
            scale_rate: 0.03,
            rotation_rate: 0.03,
            density_rate: 0.08,
            fall_share: 0.3,
            last_rate: 0.05,
            bend: 0.05,
            noise_scale: 0.05,
            cut: 3.2,
            grow_at: 50,
            grow_share: 0.15,
            weakest: 0.01,
            missing: 0.03,
        }
    }
}

impl Settings {
    /// Refuses what cannot be fitted with.
    ///
    /// # Errors
    /// [`Error::Config`] naming the key.
    pub fn check(&self) -> Result<()> {
        let positive = [
            ("first_scale", self.first_scale),
            ("least_scale", self.least_scale),
            ("greatest_scale", self.greatest_scale),
            ("bend", self.bend),
            ("cut", self.cut),
            ("fall_share", self.fall_share),
        ];
        for (key, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                return Err(Error::config(format!("gaussians.{key}"), value, "must be positive"));
            }
        }
        let rates = [
            ("position_rate", self.position_rate),
            ("scale_rate", self.scale_rate),
            ("rotation_rate", self.rotation_rate),
            ("density_rate", self.density_rate),
            ("last_rate", self.last_rate),
            ("noise_scale", self.noise_scale),
            ("grow_share", self.grow_share),
            ("weakest", self.weakest),
            ("missing", self.missing),
        ];
        for (key, value) in rates {
            if !(value.is_finite() && value >= 0.0) {
                return Err(Error::config(format!("gaussians.{key}"), value, "must not be negative"));
            }
        }
        if self.count == 0 || self.count > 1 << 20 {
            return Err(Error::config("gaussians.count", self.count, "1 to 1048576 is accepted"));
        }
        if self.least_scale > self.greatest_scale {
            let problem = format!("exceeds gaussians.greatest_scale = {}", self.greatest_scale);
            return Err(Error::config("gaussians.least_scale", self.least_scale, problem));
        }
        Ok(())
    }

    /// Factor on all rates at an iteration: 1, falling linearly at the end.
    pub fn rate(&self, step: u32) -> f64 {
        let left = f64::from(self.iterations.saturating_sub(step));
        (left / (self.fall_share * f64::from(self.iterations.max(1)))).clamp(self.last_rate, 1.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_fall_over_the_last_third() {
        let s = Settings::default();
        assert_eq!((s.rate(0), s.rate(70)), (1.0, 1.0));
        assert!((s.rate(85) - 0.5).abs() < 1e-12 && (s.rate(99) - 0.05).abs() < 1e-12);
    }

    #[test]
    fn impossible_settings_name_the_key() {
        let fault = |s: Settings| s.check().unwrap_err().to_string();
        assert!(fault(Settings { least_scale: 4.0, ..Settings::default() }).contains("gaussians.least_scale"));
        assert!(fault(Settings { bend: f64::NAN, ..Settings::default() }).contains("gaussians.bend"));
        assert!(fault(Settings { count: 0, ..Settings::default() }).contains("gaussians.count"));
    }
}
