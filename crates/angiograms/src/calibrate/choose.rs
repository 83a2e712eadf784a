//! Decides whether a correction helps, and which one: each is fitted to some planes through the sources, and tested on the others (method,
//! robustness of geometry, section 12).

use crate::calibrate::estimate::{Freedom, TEMPER};
use crate::calibrate::gauge;
use crate::calibrate::observed::Observed;
use crate::calibrate::pose::Poses;
use crate::calibrate::profiles::{Planes, Views};
use crate::calibrate::solve::{self, Misfit, Stage};
use serde::{Deserialize, Serialize};

// Blurs and steps: chosen by the true errors of 14 data sets of a procedural phantom, with errors of the views, breathing and noise.
/// Standard deviations of the blurs of the coarse stages, bins of half a pixel.
const COARSE: [f64; 2] = [24.0, 12.0];
/// Standard deviations of the blurs of the fine stages, bins of half a pixel.
const FINE: [f64; 2] = [6.0, 3.0];
/// Gauss-Newton steps of each coarse and each fine stage.
const STEPS: [usize; 2] = [2, 3];
/// A correction must remove at least this share of the squared residual of data it was not fitted to; chance removes less.
pub const MIN_GAIN: f64 = 0.02;
/// The squared residual must also drop by at least this share of the profiles' squares: without errors and noise it varies
/// by less. An error of 0.03 pixels adds this much.
pub const MIN_DROP: f64 = 5e-4;
/// Where vessels are cut off, profiles differ at any geometry, and a correction must remove this share; so must a correction of wrong tags.
/// With 2 % instead, a correction behind blades has 2.9 pixels of error where 1.3 are stated (docs/tried.md).
pub const LARGE_GAIN: f64 = 0.3;

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

/// Errors of tags that a fit expects.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tags {
    /// Errors of [`estimate`](crate::calibrate::estimate), normally distributed.
    Usual,
    /// Any errors: some tags are wrong.
    Wrong,
}

/// Fits a correction to some planes of each pair of views.
pub fn fit(observed: &Observed, correction: Correction, tags: Tags, planes: Planes) -> Poses {
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
        freedom: Freedom {
            across: true,
            angles_and_depth: fine,
            heart: breathing,
            mean_contrasts: false,
            wrong_tags: tags == Tags::Wrong,
        },
        demean: fine,
        temper: if fine { TEMPER } else { 1.0 },
    };
    COARSE.iter().for_each(|b| solve::refine(&observed.coarse, &mut poses, &stage(*b, STEPS[0], false), planes));
    gauge::fix(&observed.stands, &mut poses, breathing);
    FINE.iter().for_each(|b| solve::refine(&observed.fine, &mut poses, &stage(*b, STEPS[1], true), planes));
    gauge::fix(&observed.stands, &mut poses, breathing);
    poses
}

/// Misfit of the views in some planes.
pub fn misfit(views: &Views, poses: &Poses, planes: Planes) -> Misfit {
    solve::misfit(views, poses, FINE[1], planes)
}

/// Result of testing a correction on halves of the planes.
#[derive(Debug, Clone)]
pub struct Validated {
    /// Squared residual of each half at the corrections fitted to the other, as a share of the profiles' squares.
    pub residual: f64,
    /// Corrections fitted to each half.
    pub halves: [Poses; 2],
}

/// Fits every second stripe of the planes through two sources and tests on the other stripes, and vice versa. An error of a pose is the same in
/// all planes, and what a blade hides or another motion shows is not.
pub fn validate(observed: &Observed, correction: Correction, tags: Tags) -> Validated {
    let (mut squares, mut power) = (0.0, 0.0);
    let halves = [(Planes::Even, Planes::Odd), (Planes::Odd, Planes::Even)].map(|(fitted, tested)| {
        let poses = fit(observed, correction, tags, fitted);
        let misfit = misfit(&observed.fine, &poses, tested);
        squares += misfit.squares;
        power += misfit.power;
        poses
    });
    Validated { residual: squares / power.max(f64::MIN_POSITIVE), halves }
}

/// Returns the candidate that predicts unseen data best. A later candidate must be better than those before it by the
/// share `gain` of the squared residual, and by [`MIN_DROP`].
pub fn best(residuals: &[f64], gain: f64) -> usize {
    let mut best = 0;
    for (k, residual) in residuals.iter().enumerate() {
        if *residual < (1.0 - gain) * residuals[best] && residuals[best] - residual > MIN_DROP {
            best = k;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_correction_must_be_clearly_better() {
        assert_eq!(best(&[1.0, 0.99, 0.985], MIN_GAIN), 0);
        assert_eq!(best(&[1.0, 0.5, 0.495], MIN_GAIN), 1);
        assert_eq!(best(&[1.0, 0.5, 0.4], MIN_GAIN), 2);
        assert_eq!(best(&[1.0, 0.5, 0.4], LARGE_GAIN), 1);
        assert_eq!(best(&[0.004, 0.0036, 0.0038], MIN_GAIN), 0, "next to nothing is left as it is");
    }
}
