//! State of a fit of X-Gaussian, plain data: stored Gaussians with the optimiser's moments and statistics of each.

use crate::error::{Error, Result};
use crate::gaussians::blending::opacity::stored_opacity;
use crate::kernels::layout::{BlendGaussian, XStatistics};

/// Settings that make the steps of a fit smaller.
pub const SMALLER_STEPS: &str = "lower learning rates in section `x`: x.position_lr_init, x.feature_lr, \
                                 x.opacity_lr, x.scaling_lr, x.rotation_lr";

/// Stored Gaussians with the optimiser's moments and the statistics of density control. Together with the iteration's number,
/// this is all that a resumed fit needs.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct XState {
    /// Parameters.
    pub rows: Vec<BlendGaussian>,
    /// Set of each Gaussian.
    pub sets: Vec<u32>,
    /// First moments of Adam: position and opacity, scale and intensity, rotation.
    pub first: Vec<[f32; 12]>,
    /// Second moments, in the same layout.
    pub second: Vec<[f32; 12]>,
    /// Statistics since the last density control.
    pub statistics: Vec<XStatistics>,
}

/// Index of the opacity among the moments of a Gaussian.
const OPACITY: usize = 3;

fn retain_marked<T>(values: &mut Vec<T>, keep: &[bool]) {
    let mut marks = keep.iter();
    values.retain(|_| marks.next().is_some_and(|keep| *keep));
}

impl XState {
    /// Returns Gaussians with zero moments and statistics, and the set of each.
    pub fn fresh(rows: Vec<BlendGaussian>, sets: Vec<u32>) -> XState {
        let n = rows.len();
        let statistics = vec![XStatistics::default(); n];
        XState { rows, sets, first: vec![[0.0; 12]; n], second: vec![[0.0; 12]; n], statistics }
    }

    /// Keeps the Gaussians marked in `keep`, one mark per Gaussian.
    pub fn retain(&mut self, keep: &[bool]) {
        retain_marked(&mut self.rows, keep);
        retain_marked(&mut self.sets, keep);
        retain_marked(&mut self.first, keep);
        retain_marked(&mut self.second, keep);
        retain_marked(&mut self.statistics, keep);
    }

    /// Appends Gaussians with zero moments and statistics, and the set of each.
    pub fn append(&mut self, rows: Vec<BlendGaussian>, sets: Vec<u32>) {
        let fresh = XState::fresh(rows, sets);
        self.rows.extend(fresh.rows);
        self.sets.extend(fresh.sets);
        self.first.extend(fresh.first);
        self.second.extend(fresh.second);
        self.statistics.extend(fresh.statistics);
    }

    /// Limits the opacity of all Gaussians to `most` and resets the optimiser's moments of opacities.
    pub fn reset_opacities(&mut self, max: f64) {
        let max = stored_opacity(max.ln()) as f32;
        self.rows.iter_mut().for_each(|g| g.opacity = g.opacity.min(max));
        self.first.iter_mut().chain(&mut self.second).for_each(|moments| moments[OPACITY] = 0.0);
    }

    /// Returns the number of Gaussians of each of `n_sets` sets.
    pub fn counts(&self, n_sets: usize) -> Vec<u32> {
        let mut counts = vec![0; n_sets];
        self.sets.iter().for_each(|set| counts[*set as usize] += 1);
        counts
    }

    /// Refuses parameters that are not finite.
    ///
    /// # Errors
    /// [`Error::Diverged`] with the first such parameter.
    pub fn check(&self, step: u32) -> Result<()> {
        let numbers = |g: &BlendGaussian| {
            g.position.into_iter().chain(g.log_scale).chain(g.rotation).chain([g.opacity, g.intensity])
        };
        match self.rows.iter().flat_map(numbers).find(|v| !v.is_finite()) {
            Some(bad) => {
                let quantity = "a parameter of a Gaussian";
                Err(Error::Diverged { step: step.into(), quantity, value: bad.into(), advice: SMALLER_STEPS })
            }
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn opacities_come_back_from_what_is_stored() {
        for opacity in [1e-6f64, 0.005, 0.1, 0.5, 0.99] {
            let g = BlendGaussian { opacity: stored_opacity(opacity.ln()) as f32, ..BlendGaussian::default() };
            assert!((g.shown_opacity() / opacity - 1.0).abs() < 1e-5, "{opacity}");
            assert!((g.log_opacity() - opacity.ln()).abs() < 1e-5, "{opacity}");
        }
        // Nearly opaque Gaussians remain distinguishable.
        assert!((stored_opacity(f64::from(-1e-8f32)) - 18.42).abs() < 0.01);
    }

    #[test]
    fn reset_opacities_are_forgotten() {
        let row = |opacity: f32| BlendGaussian { opacity, ..BlendGaussian::default() };
        let mut state = XState::fresh(vec![row(2.0), row(-7.0)], vec![0, 0]);
        state.first[0] = [1.0; 12];
        state.reset_opacities(0.01);
        assert!((state.rows[0].shown_opacity() - 0.01).abs() < 1e-7);
        assert_eq!(state.rows[1].opacity, -7.0);
        assert_eq!((state.first[0][3], state.first[0][2], state.first[0][7]), (0.0, 1.0, 1.0));
    }
}
