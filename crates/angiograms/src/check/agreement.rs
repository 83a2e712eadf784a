//! Agreement of the views of a dataset, whatever the static background: the change over the beat in one view must add up,
//! in every plane through both sources, to the change in the other (see [`crate::calibrate::profiles`]).

use crate::calibrate::pose::Poses;
use crate::calibrate::profiles::{Blur, Pair, PairAtPhase, Views};
use crate::calibrate::solve::WIDE;
use rayon::prelude::*;
use serde::Serialize;

/// Sharpness of the comparison: blur of the profiles, in bins of half a pixel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Sharpness {
    /// Sharp enough to tell a turned image from an upright one.
    Fine,
    /// So blurred that an error of geometry hardly matters.
    Coarse,
}

impl Sharpness {
    /// Blur of profiles. Those of vessels alone are positive everywhere, so that unrelated ones are alike when they are blurred: there, the
    /// wide part is removed.
    fn blur(self, vessels_alone: bool) -> Blur {
        let sigma = match self {
            Sharpness::Fine => 6.0,
            Sharpness::Coarse => 24.0,
        };
        if vessels_alone { Blur::band(sigma, WIDE * sigma) } else { Blur::gaussian(sigma) }
    }
}

/// Agreement of two views.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PairAgreement {
    /// The views, by their index among those that show motion.
    pub views: [usize; 2],
    /// Squared difference of their profiles, as a share of their squares: 0 for one object, about 1 for two unrelated ones.
    pub residual: f64,
    /// Share of the squares of their profiles that varies over the phases. Vessels that move within the planes through both
    /// sources change nothing in the profiles, whose difference is then no evidence.
    pub varies: f64,
    /// Whether the verdict rests on the pair.
    pub judged: bool,
}

/// Agreement of all views.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Agreement {
    /// Squared difference of fine profiles over the judged pairs, as a share of their squares.
    pub fine: f64,
    /// Squared difference, as a share, with profiles so blurred that an error of geometry hardly matters.
    pub coarse: f64,
    /// Agreement of each pair with fine profiles.
    pub pairs: Vec<PairAgreement>,
}

/// Squared difference and squares of profiles.
type SquareSums = (f64, f64);

/// Parts of a pair over all phases. The mean over the phases is subtracted where it may be an error of the static background.
fn parts(phases: &[PairAtPhase], vessels_alone: bool) -> SquareSums {
    let Some(first) = phases.first() else { return (0.0, 0.0) };
    let mean = |side: usize, bin: usize| {
        if vessels_alone {
            return 0.0;
        }
        phases.iter().map(|at| at.profiles[side].value[bin]).sum::<f64>() / phases.len() as f64
    };
    let mut sum = (0.0, 0.0);
    for bin in 0..first.profiles[0].value.len() {
        let means = [mean(0, bin), mean(1, bin)];
        for at in phases {
            let [a, b] = [0, 1].map(|side| at.profiles[side].value[bin] - means[side]);
            sum = (sum.0 + (a - b) * (a - b), sum.1 + a * a + b * b);
        }
    }
    sum
}

fn share(parts: impl Iterator<Item = SquareSums>) -> f64 {
    let (difference, squares) = parts.fold((0.0, 0.0), |sum, p| (sum.0 + p.0, sum.1 + p.1));
    if squares > 0.0 { difference / squares } else { 0.0 }
}

/// Comparison of all pairs of views at one sharpness.
#[derive(Debug, Clone)]
pub struct Comparison {
    look: Sharpness,
    by_pair: Vec<SquareSums>,
}

impl Comparison {
    /// Compares all pairs at all phases both views have, with the geometry as stated.
    pub fn of(views: &Views, look: Sharpness) -> Comparison {
        Comparison::at(views, &Poses::stated(views.views.len(), views.n_phases), look)
    }

    /// Compares all pairs at other poses.
    pub fn at(views: &Views, poses: &Poses, look: Sharpness) -> Comparison {
        let by_pair = views.pairs.par_iter().map(|pair| compare(views, poses, *pair, look)).collect();
        Comparison { look, by_pair }
    }

    /// Returns the comparison after a change of some views: only their pairs are compared again.
    pub fn after_change(&self, views: &Views, changed: &[usize]) -> Comparison {
        let stated = Poses::stated(views.views.len(), views.n_phases);
        let again = |(pair, before): (&Pair, &SquareSums)| {
            let is_changed = pair.views.iter().any(|view| changed.contains(view));
            if is_changed { compare(views, &stated, *pair, self.look) } else { *before }
        };
        Comparison { look: self.look, by_pair: views.pairs.par_iter().zip(&self.by_pair).map(again).collect() }
    }

    /// Squared difference of all profiles, as a share of their squares.
    pub fn residual(&self) -> f64 {
        share(self.by_pair.iter().copied())
    }

    /// Returns the views that disagree with at least half of the views with which they are compared: the residual of the pair exceeds `limit`.
    pub fn suspects(&self, views: &Views, limit: f64) -> Vec<usize> {
        let is_suspect = |view: &usize| {
            let of_view = views.pairs.iter().zip(&self.by_pair).filter(|(pair, _)| pair.views.contains(view));
            let disagree: Vec<bool> = of_view.map(|(_, parts)| share(std::iter::once(*parts)) > limit).collect();
            2 * disagree.iter().filter(|disagrees| **disagrees).count() >= disagree.len().max(1)
        };
        (0..views.views.len()).filter(is_suspect).collect()
    }

    /// Squared difference of the profiles of some pairs, as a share of their squares.
    fn residual_of(&self, judged: &[bool]) -> f64 {
        share(self.by_pair.iter().zip(judged).filter(|(_, judged)| **judged).map(|(parts, _)| *parts))
    }
}

fn compare(views: &Views, poses: &Poses, pair: Pair, look: Sharpness) -> SquareSums {
    let phases: Vec<usize> = (0..views.n_phases).collect();
    parts(&views.profiles(pair, poses, &phases, &look.blur(views.vessels_alone)), views.vessels_alone)
}

/// Share of the squares of a pair's profiles that varies over the phases both views have.
pub(super) fn variation(views: &Views, pair: Pair) -> f64 {
    let poses = Poses::stated(views.views.len(), views.n_phases);
    let phases: Vec<usize> = (0..views.n_phases).collect();
    let profiles = views.profiles(pair, &poses, &phases, &Sharpness::Fine.blur(views.vessels_alone));
    let all = profiles.iter().flat_map(|at| &at.profiles).flat_map(|profile| &profile.value);
    let squares: f64 = all.map(|value| value * value).sum();
    if squares > 0.0 { parts(&profiles, views.vessels_alone).1 / squares } else { 0.0 }
}

/// Agreement of views over the pairs that constrain each other and are judged; `None` when there is no such pair.
pub fn agreement(views: &Views, judge: impl Fn(&Pair) -> bool) -> Option<Agreement> {
    let judged: Vec<bool> = views.pairs.iter().map(judge).collect();
    let fine = Comparison::of(views, Sharpness::Fine);
    let pair = |((pair, parts), judged): ((&Pair, &SquareSums), &bool)| PairAgreement {
        views: pair.views,
        residual: share(std::iter::once(*parts)),
        varies: variation(views, *pair),
        judged: *judged,
    };
    judged.contains(&true).then(|| Agreement {
        fine: fine.residual_of(&judged),
        coarse: Comparison::of(views, Sharpness::Coarse).residual_of(&judged),
        pairs: views.pairs.iter().zip(&fine.by_pair).zip(&judged).map(pair).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibrate::samples::{ANGLES, views};

    /// Views of objects that stay where they are at the first phase.
    fn at_rest(mut views: Views, vessels_alone: bool) -> Views {
        for view in &mut views.views {
            let first = view.phases[0].clone();
            view.phases.iter_mut().for_each(|phase| phase.clone_from(&first));
        }
        Views { vessels_alone, ..views }
    }

    #[test]
    fn vessels_alone_are_compared_where_they_rest() {
        let residual = |views: &Views| Comparison::of(views, Sharpness::Fine).residual();
        let unknown = at_rest(views(&ANGLES), false);
        assert!(variation(&unknown, unknown.pairs[0]) < 1e-6, "nothing moves, and the background is not known");
        let same = at_rest(views(&ANGLES), true);
        let mut other = same.clone();
        // The second view shows the object upside down.
        other.views[1].phases.iter_mut().flatten().for_each(|values| values.reverse());
        let (same, other) = (residual(&same), residual(&other));
        assert!(same < 0.01 && other > 0.1, "{same} {other}");
    }
}
