//! State of a fit of R2-Gaussian, plain data: stored Gaussians with the optimiser's moments and statistics of each.

use crate::error::{Error, Result};
use crate::kernels::layout::R2Gaussian;

/// Settings that make the steps of a fit smaller.
pub const SMALLER_STEPS: &str = "lower learning rates in section `r2`: r2.position_lr_init, r2.density_lr_init, r2.scaling_lr_init, r2.rotation_lr_init";

/// Stored Gaussians with the optimiser's moments and the statistics of density control. Together with the iteration's number,
/// this is all that a resumed fit needs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct R2State {
    /// Parameters.
    pub rows: Vec<R2Gaussian>,
    /// First moments of Adam: position and density, scale and an unused number, rotation.
    pub first: Vec<[f32; 12]>,
    /// Second moments, in the same layout.
    pub second: Vec<[f32; 12]>,
    /// Sum over iterations of the gradient with respect to the centre, in half images, and the number of times a view saw the
    /// Gaussian.
    pub statistics: Vec<[f32; 2]>,
}

fn retain_marked<T>(values: &mut Vec<T>, keep: &[bool]) {
    let mut marks = keep.iter();
    values.retain(|_| marks.next().is_some_and(|keep| *keep));
}

impl R2State {
    /// Returns Gaussians with zero moments and statistics.
    pub fn fresh(rows: Vec<R2Gaussian>) -> R2State {
        let n = rows.len();
        R2State { rows, first: vec![[0.0; 12]; n], second: vec![[0.0; 12]; n], statistics: vec![[0.0; 2]; n] }
    }

    /// Keeps the Gaussians marked in `keep`, one mark per Gaussian.
    pub fn retain(&mut self, keep: &[bool]) {
        retain_marked(&mut self.rows, keep);
        retain_marked(&mut self.first, keep);
        retain_marked(&mut self.second, keep);
        retain_marked(&mut self.statistics, keep);
    }

    /// Appends Gaussians with zero moments and statistics.
    pub fn append(&mut self, rows: Vec<R2Gaussian>) {
        let fresh = R2State::fresh(rows);
        self.rows.extend(fresh.rows);
        self.first.extend(fresh.first);
        self.second.extend(fresh.second);
        self.statistics.extend(fresh.statistics);
    }

    /// Refuses parameters that are not finite.
    ///
    /// # Errors
    /// [`Error::Diverged`] with the first such parameter.
    pub fn check(&self, step: u32) -> Result<()> {
        let numbers = |g: &R2Gaussian| g.position.into_iter().chain(g.scale).chain(g.rotation).chain([g.density]);
        match self.rows.iter().flat_map(numbers).find(|v| !v.is_finite()) {
            Some(bad) => {
                let quantity = "a parameter of a Gaussian";
                Err(Error::Diverged { step: step.into(), quantity, value: bad.into(), advice: SMALLER_STEPS })
            }
            None => Ok(()),
        }
    }
}
