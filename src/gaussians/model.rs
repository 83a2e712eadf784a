//! Fitted Gaussians: plain data.

use super::layout::{Gaussian, GaussianSetup};
use super::view::Units;
use crate::error::{Error, Result};

/// The quaternion of axes along the world's.
pub fn rotation_none() -> [f32; 4] {
    [1.0, 0.0, 0.0, 0.0]
}

/// A moving field as a set of Gaussians per phase.
#[derive(Debug, Clone, PartialEq)]
pub struct Gaussians {
    /// Their units.
    pub units: Units,
    /// Cardiac phases.
    pub n_phases: usize,
    /// Bounds of the scales, and where Gaussians end.
    pub setup: GaussianSetup,
    /// All phases', in the order of training.
    pub rows: Vec<Gaussian>,
    /// Iterations done.
    pub step: u32,
}

impl Gaussians {
    /// Gaussians of a phase.
    pub fn at(&self, phase: usize) -> impl Iterator<Item = &Gaussian> {
        self.rows.iter().filter(move |g| g.phase as usize == phase)
    }

    /// Refuses parameters that are not finite.
    ///
    /// # Errors
    /// [`Error::Diverged`] with the first of them.
    pub fn check(&self) -> Result<()> {
        let numbers = |g: &Gaussian| g.position.into_iter().chain(g.log_scale).chain(g.rotation).chain([g.log_density]);
        match self.rows.iter().flat_map(numbers).find(|v| !v.is_finite()) {
            Some(bad) => {
                let step = u64::from(self.step);
                Err(Error::Diverged { step, quantity: "parameter of a Gaussian", value: f64::from(bad) })
            }
            None => Ok(()),
        }
    }
}

/// About the largest line integral through a Gaussian, whatever the direction: through its thinnest axis.
pub fn amplitude(g: &Gaussian, setup: &GaussianSetup) -> f64 {
    let thinnest = g.log_scale.iter().copied().fold(f32::INFINITY, f32::min).exp();
    let scale = f64::from(thinnest.clamp(setup.least_scale, setup.greatest_scale));
    f64::from(g.log_density).exp() * std::f64::consts::TAU.sqrt() * scale
}
