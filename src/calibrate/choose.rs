//! Whether a correction helps, and which: fitted to some phases, tested on those it has not seen (method, robustness of
//! geometry, section 12).

use crate::calibrate::gauge;
use crate::calibrate::observed::Observed;
use crate::calibrate::pose::Poses;
use crate::calibrate::profiles::Views;
use crate::calibrate::solve::{self, Misfit, Stage};
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Blurs of the coarse stages, bins of half a pixel.
const COARSE: [f64; 2] = [24.0, 12.0];
/// And of the fine ones.
const FINE: [f64; 2] = [6.0, 3.0];
/// Gauss-Newton steps of each.
const STEPS: [usize; 2] = [2, 3];
/// Residuals of the fine stages are alike far beyond the blur: so many count as one.
const TEMPER: f64 = 10.0;
/// A correction must take this share of the squared residual away at phases it has not seen: chance takes less.
pub const LEAST_GAIN: f64 = 0.02;
/// And this share of the profiles' squares: what noise-free views leave when nothing is wrong changes by less. An error of 0.03 pixels
/// adds as much.
pub const LEAST_DROP: f64 = 5e-4;
/// Where vessels are cut off, which displacements of frames take up more than positions of views do, breathing must take this
/// share away.
pub const LARGE_GAIN: f64 = 0.3;
/// Fewer phases cannot be split.
pub const LEAST_PHASES: usize = 4;

/// How the views are corrected.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Correction {
    /// Not at all.
    Stated,
    /// Angles and position of each view.
    Static,
    /// The same, and a displacement of the heart in each frame.
    Breathing,
}

/// Corrections by the wanted phases.
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
        breathing,
        band: fine,
        angles: fine,
        demean: fine,
        temper: if fine { TEMPER } else { 1.0 },
        contrast_alone: false,
    };
    COARSE.iter().for_each(|b| solve::refine(&observed.coarse, &mut poses, &stage(*b, STEPS[0], false), phases));
    gauge::fix(&observed.stands, &mut poses, breathing);
    FINE.iter().for_each(|b| solve::refine(&observed.fine, &mut poses, &stage(*b, STEPS[1], true), phases));
    gauge::fix(&observed.stands, &mut poses, breathing);
    poses
}

/// How far the views are from agreeing at the wanted phases.
pub fn misfit(views: &Views, poses: &Poses, phases: &[usize]) -> Misfit {
    solve::misfit(views, poses, FINE[1], phases)
}

/// Displacements at phases that were not fitted: on a straight line between those beside, the nearest at the ends. Breath
/// goes on from the last phase, it does not return to the first.
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

/// What halves of the phases say of a correction.
#[derive(Debug, Clone)]
pub struct Validated {
    /// Squared residual of each half under the corrections of the other, as a share of the profiles' squares.
    pub residual: f64,
    /// Corrections by each half, for all phases.
    pub halves: [Poses; 2],
}

/// Fits the even phases and tests on the odd ones, and the other way round.
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

/// The candidate that predicts unseen phases best; a later one must be better than those before by the share `gain` of the
/// squared residual, and by [`LEAST_DROP`].
pub fn best(residuals: &[f64], gain: impl Fn(usize) -> f64) -> usize {
    let mut best = 0;
    for (k, residual) in residuals.iter().enumerate() {
        if *residual < (1.0 - gain(k)) * residuals[best] && residuals[best] - residual > LEAST_DROP {
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
        let gain = |_| LEAST_GAIN;
        assert_eq!(best(&[1.0, 0.99, 0.985], gain), 0);
        assert_eq!(best(&[1.0, 0.5, 0.495], gain), 1);
        assert_eq!(best(&[1.0, 0.5, 0.4], gain), 2);
        assert_eq!(best(&[1.0, 0.5, 0.4], |_| LARGE_GAIN), 1);
        assert_eq!(best(&[0.004, 0.0036, 0.0038], gain), 0, "next to nothing is left as it is");
    }
}
