//! Most likely corrections, by Gauss-Newton on the difference of profiles (method, robustness of geometry, section 5).

use crate::calibrate::pose::Poses;
use crate::calibrate::profiles::{Blur, Pair, PairAtPhase, Pencil, Views};
use crate::geometry::MM_PER_UNIT;
use crate::linear::Symmetric;
use glam::DVec3;
use rayon::prelude::*;

/// Expected standard deviation of errors of the angles, degrees.
pub const ANGLE_DEG: f64 = 0.3;
/// Expected standard deviation of errors of the patient's position across the view, mm.
pub const IN_PLANE_MM: f64 = 3.0;
/// Expected standard deviation of errors of the patient's position along the view, mm.
pub const DEPTH_MM: f64 = 1.0;
/// Expected standard deviation of the heart's displacement by breathing along (posterior, left, superior), mm.
pub const BREATHING_MM: [f64; 3] = [1.5, 1.5, 4.0];
/// Expected standard deviation of the contrast of a frame.
const GAIN: f64 = 0.1;
/// Standard deviation of the mean contrast of a phase's frames. Images do not determine this mean: without a prior all
/// gains tend to -1, where every residual vanishes.
const MEAN_GAIN: f64 = 1e-3;
/// Residual that is always expected, as a share of the profiles.
const FLOOR: f64 = 0.02;
/// Standard deviation of the Gaussian that a band subtracts, in standard deviations of the blur.
const WIDE: f64 = 4.0;
/// Maximum step of a translation, and of an angle.
const LONGEST_STEP_MM: f64 = 4.0;
const LONGEST_STEP_DEG: f64 = 2.0;

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
    /// Angles and depth are corrected, in addition to positions across the view.
    pub angles: bool,
    /// Each frame has a displacement of its own.
    pub breathing: bool,
    /// The part that is constant over the beat is removed: it is an error of the static background.
    pub demean: bool,
    /// Factor on the variance of the residuals: they are errors of the model, correlated between neighbours, more than
    /// noise.
    pub temper: f64,
    /// Views and frames stay fixed: only contrasts are fitted.
    pub contrast_alone: bool,
}

/// One unknown parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Unknown {
    /// View, and its primary (0) or secondary (1) angle, degrees.
    Angle(usize, usize),
    /// View, and its position along an axis of the C-arm, world units.
    Shift(usize, usize),
    /// View and phase, and the displacement along an axis of the world, world units.
    Heart(usize, usize, usize),
    /// View and phase whose relative contrast is sought.
    Gain(usize, usize),
}

impl Stage {
    fn kernel(&self) -> Blur {
        if self.band { Blur::band(self.blur, WIDE * self.blur) } else { Blur::gaussian(self.blur) }
    }
}

impl Unknown {
    fn deviation(self) -> f64 {
        match self {
            Unknown::Angle(..) => ANGLE_DEG,
            Unknown::Shift(_, 2) => DEPTH_MM / MM_PER_UNIT,
            Unknown::Shift(..) => IN_PLANE_MM / MM_PER_UNIT,
            Unknown::Heart(_, _, axis) => BREATHING_MM[axis] / MM_PER_UNIT,
            Unknown::Gain(..) => GAIN,
        }
    }

    fn value(self, views: &Views, poses: &Poses) -> f64 {
        match self {
            Unknown::Angle(v, k) => poses.views[v].angles_deg[k],
            Unknown::Shift(v, k) => poses.views[v].shift.dot(views.views[v].stand.axes().col(k)),
            Unknown::Heart(v, t, k) => poses.heart[v][t][k],
            Unknown::Gain(v, t) => poses.gains[v][t],
        }
    }

    fn add(self, step: f64, views: &Views, poses: &mut Poses) {
        match self {
            Unknown::Angle(v, k) => poses.views[v].angles_deg[k] += step,
            Unknown::Shift(v, k) => poses.views[v].shift += step * views.views[v].stand.axes().col(k),
            Unknown::Heart(v, t, k) => poses.heart[v][t][k] += step,
            Unknown::Gain(v, t) => poses.gains[v][t] += step,
        }
    }
}

/// All unknowns of a stage: those of a view, then those of each of its frames, view by view.
struct Unknowns {
    all: Vec<Unknown>,
    /// Unknowns of each view.
    of_view: Vec<Vec<usize>>,
    /// Unknowns of each frame, `[view][phase]`.
    of_frame: Vec<Vec<Vec<usize>>>,
}

impl Unknowns {
    fn of(views: &Views, stage: &Stage, phases: &[usize]) -> Unknowns {
        let mut unknowns = Unknowns { all: Vec::new(), of_view: Vec::new(), of_frame: Vec::new() };
        for (v, view) in views.views.iter().enumerate() {
            let mut of_view = Vec::new();
            if !stage.contrast_alone {
                of_view.extend([Unknown::Shift(v, 0), Unknown::Shift(v, 1)]);
                if stage.angles {
                    of_view.extend([Unknown::Angle(v, 0), Unknown::Angle(v, 1), Unknown::Shift(v, 2)]);
                }
            }
            let of_view = unknowns.add(of_view);
            unknowns.of_view.push(of_view);
            let mut of_frame = vec![Vec::new(); views.n_phases];
            for t in phases.iter().copied().filter(|t| view.phases[*t].is_some()) {
                let mut of_this = vec![Unknown::Gain(v, t)];
                if stage.breathing && !stage.contrast_alone {
                    of_this.extend((0..3).map(|k| Unknown::Heart(v, t, k)));
                }
                of_frame[t] = unknowns.add(of_this);
            }
            unknowns.of_frame.push(of_frame);
        }
        unknowns
    }

    /// Appends unknowns and returns their indices.
    fn add(&mut self, more: Vec<Unknown>) -> Vec<usize> {
        let first = self.all.len();
        self.all.extend(more);
        (first..self.all.len()).collect()
    }
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

fn difference(gains: [f64; 2], a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| (1.0 + gains[0]) * a - (1.0 + gains[1]) * b).collect()
}

impl Residuals {
    fn of(at: &PairAtPhase, pair: Pair, views: &Views, poses: &Poses, unknowns: &Unknowns) -> Residuals {
        let [a, b] = &at.profiles;
        let gains = pair.views.map(|v| poses.gains[v][at.phase]);
        let mut columns = Vec::new();
        for (side, v) in pair.views.into_iter().enumerate() {
            let indices = unknowns.of_view[v].iter().chain(&unknowns.of_frame[v][at.phase]);
            for index in indices.copied() {
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
        let power = a.value.iter().chain(&b.value).map(|p| p * p).sum::<f64>() / 2.0;
        Residuals { value: difference(gains, &a.value, &b.value), columns, power }
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
    matrix: Symmetric,
    gradient: Vec<f64>,
    squares: f64,
    power: f64,
    count: usize,
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

impl PairTerms {
    fn of(views: &Views, pair: Pair, poses: &Poses, stage: &Stage, phases: &[usize], unknowns: &Unknowns) -> PairTerms {
        let blur = stage.kernel();
        let profiles = views.profiles(pair, poses, phases, &blur);
        let residuals: Vec<Residuals> =
            profiles.iter().map(|at| Residuals::of(at, pair, views, poses, unknowns)).collect();
        let mut terms = PairTerms {
            matrix: Symmetric::zeros(unknowns.all.len()),
            gradient: vec![0.0; unknowns.all.len()],
            squares: 0.0,
            power: 0.0,
            count: 0,
        };
        for r in &residuals {
            terms.add(&r.value, &r.columns, 1.0);
            terms.power += r.power;
            terms.count += r.value.iter().filter(|v| **v != 0.0).count();
        }
        if stage.demean && !residuals.is_empty() {
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

    fn add(&mut self, value: &[f64], columns: &[(usize, Vec<f64>)], scale: f64) {
        self.squares += scale * dot(value, value);
        for (k, (i, a)) in columns.iter().enumerate() {
            self.gradient[*i] += scale * dot(a, value);
            for (j, b) in &columns[..=k] {
                self.matrix.add(*i, *j, scale * dot(a, b));
            }
        }
    }
}

/// Sum of all pairs' terms, divided by the expected variance of the residuals, and the priors.
struct Normal {
    matrix: Symmetric,
    gradient: Vec<f64>,
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
}

impl Normal {
    fn of(views: &Views, poses: &Poses, stage: &Stage, phases: &[usize], unknowns: &Unknowns) -> (Normal, Misfit) {
        let term = |pair: &Pair| PairTerms::of(views, *pair, poses, stage, phases, unknowns);
        let terms: Vec<PairTerms> = views.pairs.par_iter().map(term).collect();
        let n = unknowns.all.len();
        let mut normal = Normal { matrix: Symmetric::zeros(n), gradient: vec![0.0; n] };
        let mut misfit = Misfit { squares: 0.0, power: 0.0, count: 0 };
        for t in &terms {
            normal.matrix.add_all(&t.matrix);
            normal.gradient.iter_mut().zip(&t.gradient).for_each(|(g, t)| *g += t);
            misfit.squares += t.squares;
            misfit.power += t.power;
            misfit.count += t.count;
        }
        let count = misfit.count.max(1) as f64;
        let expected = misfit.squares / count + FLOOR * FLOOR * misfit.power / count;
        // Blurred residuals are correlated between neighbours.
        let alike = 2.0 * std::f64::consts::PI.sqrt() * stage.blur;
        let variance = expected * alike * stage.temper;
        normal.matrix.scale(1.0 / variance);
        normal.gradient.iter_mut().for_each(|g| *g /= variance);
        normal.add_priors(views, poses, unknowns);
        (normal, misfit)
    }

    fn add_priors(&mut self, views: &Views, poses: &Poses, unknowns: &Unknowns) {
        for (i, unknown) in unknowns.all.iter().enumerate() {
            self.matrix.add(i, i, 1.0);
            self.gradient[i] += unknown.value(views, poses) / unknown.deviation();
        }
        for phase in 0..views.n_phases {
            let here = |u: &Unknown| matches!(u, Unknown::Gain(_, t) if *t == phase);
            let gains: Vec<usize> = (0..unknowns.all.len()).filter(|i| here(&unknowns.all[*i])).collect();
            let weight = (GAIN / MEAN_GAIN).powi(2);
            let sum: f64 = gains.iter().map(|i| unknowns.all[*i].value(views, poses) / GAIN).sum();
            for (k, i) in gains.iter().enumerate() {
                self.gradient[*i] += weight * sum;
                gains[..=k].iter().for_each(|j| self.matrix.add(*i, *j, weight));
            }
        }
    }
}

/// Runs a stage's steps on the wanted phases. Poses do not change where there is no information.
pub fn refine(views: &Views, poses: &mut Poses, stage: &Stage, phases: &[usize]) {
    let unknowns = Unknowns::of(views, stage, phases);
    for _ in 0..stage.steps {
        let (normal, misfit) = Normal::of(views, poses, stage, phases, &unknowns);
        if misfit.power == 0.0 {
            return;
        }
        let Some(mut step) = normal.matrix.solve(&normal.gradient) else { return };
        let longest = LONGEST_STEP_MM / MM_PER_UNIT;
        for (unknown, step) in unknowns.all.iter().zip(&mut step) {
            *step *= -unknown.deviation();
        }
        let too_long = |(u, step): (&Unknown, &f64)| match u {
            Unknown::Shift(..) | Unknown::Heart(..) => step.abs() / longest,
            Unknown::Angle(..) => step.abs() / LONGEST_STEP_DEG,
            Unknown::Gain(..) => 0.0,
        };
        let scale = 1.0 / unknowns.all.iter().zip(&step).map(too_long).fold(1.0, f64::max);
        unknowns.all.iter().zip(step).for_each(|(u, s)| u.add(scale * s, views, poses));
    }
}

/// Misfit of the views at the wanted phases, with the contrasts of the frames fitted.
pub fn misfit(views: &Views, poses: &Poses, blur: f64, phases: &[usize]) -> Misfit {
    let stage = Stage {
        blur,
        band: true,
        steps: 2,
        angles: false,
        breathing: false,
        demean: true,
        temper: 1.0,
        contrast_alone: true,
    };
    let mut fitted = Poses { gains: Poses::stated(views.views.len(), views.n_phases).gains, ..poses.clone() };
    refine(views, &mut fitted, &stage, phases);
    let unknowns = Unknowns::of(views, &stage, &[]);
    Normal::of(views, &fitted, &stage, phases, &unknowns).1
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
            angles: true,
            breathing: true,
            demean: false,
            temper: 1.0,
            contrast_alone: false,
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
        profiles.iter().map(|at| Residuals::of(at, pair, views, poses, unknowns)).collect()
    }

    #[test]
    fn a_pair_has_one_profile() {
        let views = views(&ANGLES);
        assert_eq!(views.pairs.len(), 3);
        let at_truth = misfit(&views, &Poses::stated(3, PHASES), 4.0, &[0, 1, 2]).share();
        assert!(at_truth < 0.002, "{at_truth}");
        let apart = misfit(&views, &off(3), 4.0, &[0, 1, 2]).share();
        assert!(apart > 0.02, "{apart}");
    }

    #[test]
    fn slopes_are_those_of_the_residuals() {
        let views = views(&ANGLES);
        let unknowns = Unknowns::of(&views, &stage(), &[0, 1, 2]);
        let poses = off(3);
        for pair in views.pairs.iter().copied() {
            let here = residuals(&views, pair, &poses, &unknowns);
            for (t, at) in here.iter().enumerate() {
                for (index, column) in &at.columns {
                    let unknown = unknowns.all[*index];
                    let step = 1e-3 * unknown.deviation();
                    let moved = |sign: f64| {
                        let mut moved = poses.clone();
                        unknown.add(sign * step, &views, &mut moved);
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
        let unknowns = Unknowns::of(&views, &stage(), &[]);
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
