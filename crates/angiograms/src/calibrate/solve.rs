//! Most likely corrections, by Gauss-Newton on the difference of profiles (method, robustness of geometry, section 5).

use crate::calibrate::estimate::{Freedom, Normal, Unknown, Unknowns};
use crate::calibrate::pose::Poses;
use crate::calibrate::profiles::{Blur, Moving, Pair, PairAtPhase, Pencil, Planes, Views};
use glam::DVec3;
use rayon::prelude::*;

/// Residual that is always expected, as a share of the root mean square of the profiles.
const FLOOR: f64 = 0.02;
/// Standard deviation of the Gaussian that a band subtracts, in standard deviations of the blur.
pub(crate) const WIDE: f64 = 4.0;

/// Parameters that a stage corrects, and its settings.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Stage {
    /// Blur of the profiles, standard deviation in bins of half a pixel.
    pub blur: f64,
    /// Structures that are several times smoother than the blur are suppressed: moving hearts and lungs, which views mask
    /// differently.
    pub band: bool,
    /// Gauss-Newton steps.
    pub steps: usize,
    /// Corrections that are sought.
    pub freedom: Freedom,
    /// The part that is constant over the beat is removed: it is an error of the static background.
    pub demean: bool,
    /// Factor on the variance of the residuals: they are errors of the model, correlated between neighbours, more than
    /// noise.
    pub temper: f64,
}

impl Stage {
    fn kernel(&self) -> Blur {
        if self.band { Blur::band(self.blur, WIDE * self.blur) } else { Blur::gaussian(self.blur) }
    }
}

fn all_phases(views: &Views) -> Vec<usize> {
    (0..views.n_phases).collect()
}

/// Collects the unknowns of a stage at some phases.
fn unknowns(views: &Views, stage: &Stage, phases: &[usize]) -> Unknowns {
    let axes = views.views.iter().map(|view| view.stand.axes()).collect();
    let shown = |view: &Moving| phases.iter().copied().filter(|t| view.phases[*t].is_some()).collect();
    Unknowns::new(axes, stage.freedom, &views.views.iter().map(shown).collect::<Vec<_>>())
}

/// Derivative of a pair's pencil by one unknown: velocity of the baseline's end relative to its beginning, and the
/// rotations of the two views.
#[derive(Debug, Clone, Copy, Default)]
struct PencilMotion {
    way: DVec3,
    turns: [DVec3; 2],
}

impl PencilMotion {
    /// Factors on [`crate::calibrate::profiles::Profile`]'s slopes `turned`, `towards_first` and `towards_second` of each view.
    fn factors(&self, pencil: &Pencil, axes: [DVec3; 2]) -> [[f64; 3]; 2] {
        let Pencil { baseline, first, second, length, middle: [across, along] } = *pencil;
        let tilt = [first.dot(self.way) / length, second.dot(self.way) / length];
        let middle: DVec3 = self.turns.iter().zip(axes).map(|(turn, axis)| turn.cross(axis)).sum();
        // The zero of the planes' angles moves with the views' common direction.
        let twist = (middle.dot(second) - along * tilt[1]) / across;
        self.turns.map(|turn| [twist - turn.dot(baseline), tilt[0] - turn.dot(second), tilt[1] + turn.dot(first)])
    }
}

/// Residuals of a pair at a phase, and their slopes.
struct Residuals {
    value: Vec<f64>,
    /// Indices of unknowns, with the change of the residuals per prior standard deviation.
    columns: Vec<(usize, Vec<f64>)>,
    /// Sum of the squares of the profiles.
    power: f64,
}

/// Sets what lies in other planes to zero.
fn keep_planes(values: &mut [f64], first_bin: i64, planes: Planes) {
    values.iter_mut().zip(first_bin..).filter(|(_, bin)| !planes.hold(*bin)).for_each(|(value, _)| *value = 0.0);
}

fn difference(gains: [f64; 2], a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| (1.0 + gains[0]) * a - (1.0 + gains[1]) * b).collect()
}

impl Residuals {
    fn of(
        at: &PairAtPhase,
        pair: Pair,
        views: &Views,
        poses: &Poses,
        unknowns: &Unknowns,
        planes: Planes,
    ) -> Residuals {
        let [a, b] = &at.profiles;
        let gains = pair.views.map(|v| poses.gains[v][at.phase]);
        let mut columns = Vec::new();
        for (side, v) in pair.views.into_iter().enumerate() {
            for index in unknowns.of_frame(v, at.phase) {
                let unknown = unknowns.all[index];
                let column = match motion_of(unknown, side, v, views, poses) {
                    None => {
                        let sign = if side == 0 { 1.0 } else { -1.0 };
                        at.profiles[side].value.iter().map(|p| sign * p).collect()
                    }
                    Some(motion) => slope(at, pair, views, poses, &motion, gains),
                };
                let scaled: Vec<f64> = column.into_iter().map(|c: f64| c * unknown.deviation()).collect();
                columns.push((index, scaled));
            }
        }
        let mut value = difference(gains, &a.value, &b.value);
        let mut squares: Vec<f64> = a.value.iter().zip(&b.value).map(|(a, b)| (a * a + b * b) / 2.0).collect();
        if planes != Planes::All {
            let all = columns.iter_mut().map(|(_, column)| column).chain([&mut value, &mut squares]);
            all.for_each(|values| keep_planes(values, at.first_bin, planes));
        }
        Residuals { value, columns, power: squares.iter().sum() }
    }
}

/// Motion of the pencil by an unknown of a pair's first (0) or second (1) view; `None` for contrasts.
fn motion_of(unknown: Unknown, side: usize, v: usize, views: &Views, poses: &Poses) -> Option<PencilMotion> {
    // The source moves opposite to the patient; the baseline ends at the second view's source.
    let sign = if side == 0 { -1.0 } else { 1.0 };
    let (stand, pose) = (&views.views[v].stand, &poses.views[v]);
    match unknown {
        Unknown::Gain(..) => None,
        Unknown::Shift(_, k) => Some(PencilMotion { way: -sign * stand.axes().col(k), ..PencilMotion::default() }),
        Unknown::Heart(_, _, k) => Some(PencilMotion { way: -sign * DVec3::AXES[k], ..PencilMotion::default() }),
        Unknown::Angle(_, k) => {
            let turn = stand.turning_axes(pose)[k] * 1f64.to_radians();
            let mut turns = [DVec3::ZERO; 2];
            turns[side] = turn;
            Some(PencilMotion { way: sign * turn.cross(stand.source_in_room(pose)), turns })
        }
    }
}

/// Change of a pair's residuals when its pencil moves.
fn slope(
    at: &PairAtPhase,
    pair: Pair,
    views: &Views,
    poses: &Poses,
    motion: &PencilMotion,
    gains: [f64; 2],
) -> Vec<f64> {
    let axes = pair.views.map(|v| views.views[v].stand.corrected_axes(&poses.views[v]).z_axis);
    let factors = motion.factors(&at.pencil, axes);
    let changes = at.profiles.iter().zip(factors).map(|(p, [turn, first, second])| {
        let slopes = p.turned.iter().zip(&p.towards_first).zip(&p.towards_second);
        slopes.map(|((t, f), s)| turn * t + first * f + second * s).collect::<Vec<f64>>()
    });
    let changes: Vec<Vec<f64>> = changes.collect();
    difference(gains, &changes[0], &changes[1])
}

/// Contribution of all phases of a pair to the normal equations.
struct PairTerms {
    normal: Normal,
    misfit: Misfit,
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

impl PairTerms {
    fn of(views: &Views, pair: Pair, poses: &Poses, stage: &Stage, planes: Planes, unknowns: &Unknowns) -> PairTerms {
        let blur = stage.kernel();
        let profiles = views.profiles(pair, poses, &all_phases(views), &blur);
        let residual = |at: &PairAtPhase| Residuals::of(at, pair, views, poses, unknowns, planes);
        let residuals: Vec<Residuals> = profiles.iter().map(residual).collect();
        let mut terms = PairTerms::none(unknowns);
        for r in &residuals {
            terms.add(&r.value, &r.columns, 1.0);
            terms.misfit.power += r.power;
            terms.misfit.count += r.value.iter().filter(|v| **v != 0.0).count();
        }
        if stage.demean && !views.vessels_alone && !residuals.is_empty() {
            // The sum of squared deviations from the mean is that of the values minus that of the mean.
            let mut mean = vec![0.0; residuals[0].value.len()];
            let mut columns: Vec<(usize, Vec<f64>)> = Vec::new();
            for r in &residuals {
                mean.iter_mut().zip(&r.value).for_each(|(m, v)| *m += v);
                for (index, column) in &r.columns {
                    match columns.iter_mut().find(|(other, _)| other == index) {
                        Some((_, sum)) => sum.iter_mut().zip(column).for_each(|(s, c)| *s += c),
                        None => columns.push((*index, column.clone())),
                    }
                }
            }
            terms.add(&mean, &columns, -1.0 / residuals.len() as f64);
        }
        terms
    }

    fn none(unknowns: &Unknowns) -> PairTerms {
        let misfit = Misfit { squares: 0.0, power: 0.0, count: 0 };
        PairTerms { normal: Normal::zeros(unknowns.all.len()), misfit }
    }

    fn add(&mut self, value: &[f64], columns: &[(usize, Vec<f64>)], scale: f64) {
        self.misfit.squares += scale * dot(value, value);
        let indices: Vec<usize> = columns.iter().map(|(index, _)| *index).collect();
        let product = |k: usize, l: usize| scale * dot(&columns[k].1, &columns[l].1);
        self.normal.add(&indices, product, |k| scale * dot(&columns[k].1, value));
    }

    /// Returns the sum over all pairs.
    fn sum(views: &Views, poses: &Poses, stage: &Stage, planes: Planes, unknowns: &Unknowns) -> PairTerms {
        let term = |pair: &Pair| PairTerms::of(views, *pair, poses, stage, planes, unknowns);
        let terms: Vec<PairTerms> = views.pairs.par_iter().map(term).collect();
        terms.iter().fold(PairTerms::none(unknowns), |mut sum, PairTerms { normal, misfit }| {
            sum.normal.add_all(normal);
            sum.misfit.squares += misfit.squares;
            sum.misfit.power += misfit.power;
            sum.misfit.count += misfit.count;
            sum
        })
    }
}

/// Sums of squares over all pairs, phases and bins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Misfit {
    /// Sum of the squares of the residuals.
    pub squares: f64,
    /// Sum of the squares of the profiles.
    pub power: f64,
    count: usize,
}

impl Misfit {
    /// Residuals as a share of the profiles.
    pub fn share(&self) -> f64 {
        (self.squares / self.power.max(f64::MIN_POSITIVE)).sqrt()
    }

    /// Expected variance of the residuals of a stage.
    fn variance(&self, stage: &Stage) -> f64 {
        let count = self.count.max(1) as f64;
        let expected = self.squares / count + FLOOR * FLOOR * self.power / count;
        // Blurred residuals are correlated between neighbours.
        let alike = 2.0 * std::f64::consts::PI.sqrt() * stage.blur;
        expected * alike * stage.temper
    }
}

/// Runs a stage's steps on some planes. Poses do not change where there is no information.
pub fn refine(views: &Views, poses: &mut Poses, stage: &Stage, planes: Planes) {
    let unknowns = unknowns(views, stage, &all_phases(views));
    for _ in 0..stage.steps {
        let PairTerms { normal, misfit } = PairTerms::sum(views, poses, stage, planes, &unknowns);
        if misfit.power == 0.0 {
            return;
        }
        let Some(next) = normal.stepped(misfit.variance(stage), &unknowns, poses) else { return };
        *poses = next;
    }
}

/// Misfit of the views in some planes, with the contrasts of the frames fitted.
pub fn misfit(views: &Views, poses: &Poses, blur: f64, planes: Planes) -> Misfit {
    let stage = Stage { blur, band: true, steps: 2, freedom: Freedom::CONTRASTS, demean: true, temper: 1.0 };
    let mut fitted = Poses { gains: Poses::stated(views.views.len(), views.n_phases).gains, ..poses.clone() };
    refine(views, &mut fitted, &stage, planes);
    PairTerms::sum(views, &fitted, &stage, planes, &unknowns(views, &stage, &[])).misfit
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibrate::pose::StatedView;
    use crate::calibrate::samples::{ANGLES, PHASES, views};

    fn stage() -> Stage {
        Stage {
            blur: 4.0,
            band: true,
            steps: 1,
            freedom: Freedom { mean_contrasts: false, ..Freedom::ALL },
            demean: false,
            temper: 1.0,
        }
    }

    /// Poses that all differ from the true ones.
    fn off(n_views: usize) -> Poses {
        let mut poses = Poses::stated(n_views, PHASES);
        for v in 0..n_views {
            poses.views[v].angles_deg = [0.4 - 0.3 * v as f64, 0.2 * v as f64 - 0.1];
            poses.views[v].shift = DVec3::new(0.004, -0.003 * v as f64, 0.002);
            for t in 0..PHASES {
                poses.heart[v][t] = DVec3::new(0.001 * t as f64, 0.002, -0.001 * v as f64);
                poses.gains[v][t] = 0.05 * v as f64 - 0.02 * t as f64;
            }
        }
        poses
    }

    fn residuals(views: &Views, pair: Pair, poses: &Poses, unknowns: &Unknowns) -> Vec<Residuals> {
        let profiles = views.profiles(pair, poses, &[0, 1, 2], &stage().kernel());
        profiles.iter().map(|at| Residuals::of(at, pair, views, poses, unknowns, Planes::All)).collect()
    }

    #[test]
    fn a_pair_has_one_profile() {
        let views = views(&ANGLES);
        assert_eq!(views.pairs.len(), 3);
        let at_truth = misfit(&views, &Poses::stated(3, PHASES), 4.0, Planes::All).share();
        assert!(at_truth < 0.002, "{at_truth}");
        let apart = misfit(&views, &off(3), 4.0, Planes::All).share();
        assert!(apart > 0.02, "{apart}");
    }

    #[test]
    fn poses_fitted_to_half_of_the_planes_explain_the_other_half() {
        let views = views(&ANGLES);
        let [even, odd] = [Planes::Even, Planes::Odd];
        let mut poses = off(3);
        let power = |planes: Planes| misfit(&views, &poses, 4.0, planes).power;
        let (halves, whole) = ([power(even), power(odd)], power(Planes::All));
        assert!((halves[0] + halves[1] - whole).abs() < 1e-6 * whole, "{halves:?} of {whole}");
        assert!(halves.iter().all(|half| *half > 0.1 * whole), "{halves:?} of {whole}");
        let before = misfit(&views, &poses, 4.0, odd).share();
        refine(&views, &mut poses, &Stage { steps: 4, ..stage() }, even);
        let after = misfit(&views, &poses, 4.0, odd).share();
        assert!(after < 0.5 * before, "{before} before, {after} after");
    }

    #[test]
    fn slopes_are_those_of_the_residuals() {
        let views = views(&ANGLES);
        let unknowns = unknowns(&views, &stage(), &[0, 1, 2]);
        let poses = off(3);
        for pair in views.pairs.iter().copied() {
            let here = residuals(&views, pair, &poses, &unknowns);
            for (t, at) in here.iter().enumerate() {
                for (index, column) in &at.columns {
                    let unknown = unknowns.all[*index];
                    let step = 1e-3 * unknown.deviation();
                    let moved = |sign: f64| {
                        let mut moved = poses.clone();
                        unknown.add(sign * step, &unknowns.axes, &mut moved);
                        residuals(&views, pair, &moved, &unknowns).swap_remove(t).value
                    };
                    let want: Vec<f64> = moved(1.0).iter().zip(moved(-1.0)).map(|(a, b)| (a - b) / 2e-3).collect();
                    let norm = |v: &mut dyn Iterator<Item = f64>| v.map(|x| x * x).sum::<f64>().sqrt();
                    let apart = norm(&mut want.iter().zip(column).map(|(a, b)| a - b));
                    let size = norm(&mut want.iter().copied());
                    // Each pixel is shared between two bins, which the kernel's slope ignores.
                    assert!(apart < 0.1 * size + 1e-9, "{pair:?}, phase {t}, {unknown:?}: {apart:.2e} of {size:.2e}");
                }
            }
        }
    }

    #[test]
    fn a_common_motion_changes_no_residual() {
        let views = views(&ANGLES);
        let poses = off(3);
        let stands: Vec<StatedView> = views.views.iter().map(|v| v.stand.clone()).collect();
        let mut fixed = poses.clone();
        crate::calibrate::gauge::fix(&stands, &mut fixed, true);
        let moved = (poses.views[0].shift - fixed.views[0].shift).length();
        assert!(moved > 1e-3 && (fixed.views[0].angles_deg[0] - poses.views[0].angles_deg[0]).abs() > 0.05, "{moved}");
        let unknowns = unknowns(&views, &stage(), &[]);
        for pair in views.pairs.iter().copied() {
            let (before, after) =
                (residuals(&views, pair, &poses, &unknowns), residuals(&views, pair, &fixed, &unknowns));
            for (a, b) in before.iter().zip(&after) {
                let max = a.value.iter().copied().fold(0.0, |m: f64, v| m.max(v.abs()));
                assert!(max > 0.0 && a.value.iter().zip(&b.value).all(|(a, b)| (a - b).abs() < 1e-9 * max));
            }
        }
        let mean: f64 = fixed.views.iter().map(|p| p.angles_deg[0]).sum();
        assert!(mean.abs() < 1e-12);
    }

    #[test]
    fn opposite_views_say_nothing_of_each_other() {
        assert_eq!(views(&[(0.0, 0.0), (180.0, 0.0)]).pairs, []);
        assert_eq!(views(&[(10.0, 0.0), (10.5, 0.0)]).pairs, []);
    }
}
