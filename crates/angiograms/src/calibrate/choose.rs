//! Decides whether a correction helps, and which one: each is fitted to some phases and tested on the others (method,
//! robustness of geometry, section 12).

use crate::calibrate::estimate::{Freedom, TEMPER};
use crate::calibrate::gauge;
use crate::calibrate::observed::Observed;
use crate::calibrate::pose::Poses;
use crate::calibrate::profiles::Views;
use crate::calibrate::solve::{self, Misfit, Stage};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Blurs of the coarse stages, bins of half a pixel.
const COARSE: [f64; 2] = [24.0, 12.0];
/// Blurs of the fine stages, bins of half a pixel.
const FINE: [f64; 2] = [6.0, 3.0];
/// Gauss-Newton steps of each coarse and each fine stage.
const STEPS: [usize; 2] = [2, 3];
/// A correction must remove at least this share of the squared residual at phases it was not fitted to; chance removes
/// less.
pub const MIN_GAIN: f64 = 0.02;
/// The squared residual must also drop by at least this share of the profiles' squares: without errors and noise it varies
/// by less. An error of 0.03 pixels adds this much.
pub const MIN_DROP: f64 = 5e-4;
/// Where vessels are cut off, breathing must remove this share: displacements of frames compensate for cut-off vessels more
/// than positions of views do.
pub const LARGE_GAIN: f64 = 0.3;
/// Minimum number of phases that can be split into two halves.
pub const MIN_PHASES: usize = 4;

/// Kind of correction of the views.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Correction {
    /// No correction: the geometry as stated.
    Stated,
    /// Angles and position of each view.
    Static,
    /// Angles and position of each view, and a displacement of the heart in each frame.
    Breathing,
}

/// Fits a correction to the wanted phases.
pub fn fit(observed: &Observed, correction: Correction, phases: &[usize]) -> Poses {
    let mut poses = Poses::stated(observed.views.len(), observed.n_phases());
    let breathing = match correction {
        Correction::Stated => return poses,
        Correction::Static => false,
        Correction::Breathing => true,
    };
    let stage = |blur, steps, fine: bool| Stage {
        blur,
        steps,
        band: fine,
        freedom: Freedom { across: true, angles_and_depth: fine, heart: breathing, mean_contrasts: false },
        demean: fine,
        temper: if fine { TEMPER } else { 1.0 },
    };
    COARSE.iter().for_each(|b| solve::refine(&observed.coarse, &mut poses, &stage(*b, STEPS[0], false), phases));
    gauge::fix(&observed.stands, &mut poses, breathing);
    FINE.iter().for_each(|b| solve::refine(&observed.fine, &mut poses, &stage(*b, STEPS[1], true), phases));
    gauge::fix(&observed.stands, &mut poses, breathing);
    poses
}

/// Misfit of the views at the wanted phases.
pub fn misfit(views: &Views, poses: &Poses, phases: &[usize]) -> Misfit {
    solve::misfit(views, poses, FINE[1], phases)
}

/// Fills in the displacements at phases that were not fitted: linear between the neighbouring fitted phases, and the
/// nearest one at the ends. Breathing does not return at the last phase to its state at the first, so the phases are not
/// cyclic here.
fn between(heart: &mut [DVec3], fitted: &[usize]) {
    for t in (0..heart.len()).filter(|t| !fitted.contains(t)) {
        let before = fitted.iter().copied().filter(|f| *f < t).max();
        let after = fitted.iter().copied().filter(|f| *f > t).min();
        heart[t] = match (before, after) {
            (Some(a), Some(b)) => heart[a].lerp(heart[b], (t - a) as f64 / (b - a) as f64),
            (Some(near), None) | (None, Some(near)) => heart[near],
            (None, None) => DVec3::ZERO,
        };
    }
}

/// Result of testing a correction on halves of the phases.
#[derive(Debug, Clone)]
pub struct Validated {
    /// Squared residual of each half at the corrections fitted to the other, as a share of the profiles' squares.
    pub residual: f64,
    /// Corrections fitted to each half, for all phases.
    pub halves: [Poses; 2],
}

/// Fits the even phases and tests on the odd ones, and vice versa.
pub fn validate(observed: &Observed, correction: Correction) -> Validated {
    let parity = |odd: usize| (0..observed.n_phases()).filter(|t| t % 2 == odd).collect::<Vec<usize>>();
    let (mut squares, mut power) = (0.0, 0.0);
    let halves = [0, 1].map(|odd| {
        let (fitted, tested) = (parity(odd), parity(1 - odd));
        let mut poses = fit(observed, correction, &fitted);
        poses.heart.iter_mut().for_each(|of_view| between(of_view, &fitted));
        let misfit = misfit(&observed.fine, &poses, &tested);
        squares += misfit.squares;
        power += misfit.power;
        poses
    });
    Validated { residual: squares / power.max(f64::MIN_POSITIVE), halves }
}

/// Returns the candidate that predicts unseen phases best. A later candidate must be better than those before it by the
/// share `gain` of the squared residual, and by [`MIN_DROP`].
pub fn best(residuals: &[f64], gain: impl Fn(usize) -> f64) -> usize {
    let mut best = 0;
    for (k, residual) in residuals.iter().enumerate() {
        if *residual < (1.0 - gain(k)) * residuals[best] && residuals[best] - residual > MIN_DROP {
            best = k;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn displacements_go_straight_from_phase_to_phase() {
        let mut heart = vec![DVec3::ZERO; 6];
        (heart[1], heart[3]) = (DVec3::X, DVec3::X * 3.0);
        between(&mut heart, &[1, 3]);
        assert_eq!(heart.iter().map(|h| h.x).collect::<Vec<_>>(), [1.0, 1.0, 2.0, 3.0, 3.0, 3.0]);
    }

    #[test]
    fn a_correction_must_be_clearly_better() {
        let gain = |_| MIN_GAIN;
        assert_eq!(best(&[1.0, 0.99, 0.985], gain), 0);
        assert_eq!(best(&[1.0, 0.5, 0.495], gain), 1);
        assert_eq!(best(&[1.0, 0.5, 0.4], gain), 2);
        assert_eq!(best(&[1.0, 0.5, 0.4], |_| LARGE_GAIN), 1);
        assert_eq!(best(&[0.004, 0.0036, 0.0038], gain), 0, "next to nothing is left as it is");
    }
}
