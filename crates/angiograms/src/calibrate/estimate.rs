//! Estimates corrections of views and frames: the unknowns, the priors of their values, and the normal equations of Gauss-Newton steps.
//!
//! Residuals and their derivatives belong to the callers, who compare profiles of pairs of views ([`crate::calibrate::solve`]) or images
//! with those of a field. Corrections are measured from the stated geometry: priors describe its errors, and a calibration has used the
//! same images.

use crate::calibrate::pose::Poses;
use crate::geometry::MM_PER_UNIT;
use crate::linear::Symmetric;
use glam::DMat3;
use std::collections::BTreeMap;
use std::iter::zip;

/// Standard deviation of errors of the angles, degrees: that of angles which are rounded to whole degrees (1 / sqrt(12)).
pub const ANGLE_DEG: f64 = 0.3;
/// Standard deviation of errors of the patient's position across the view, mm.
pub const ACROSS_MM: f64 = 3.0;
/// Standard deviation of errors of the patient's position along the view, mm. Images hardly determine it.
pub const DEPTH_MM: f64 = 1.0;
/// Standard deviations of the heart's displacement by breathing along (posterior, left, superior), mm. Ten patients moved by 4.9 +- 1.9 mm
/// along the body and 1.3 +- 1.8 mm to the front, peak to peak (Shechter et al. 2004, `docs/degradations.md`). Sines whose peak to peak is
/// the mean and one standard deviation have 2.4 and 1.1 mm. Motion to the left, of which the authors report none, is smaller.
pub const HEART_MM: [f64; 3] = [1.0, 0.6, 2.5];
/// Standard deviation of the contrast of a frame, as a share: that within a run with moderate errors (`docs/degradations.md`). With twice
/// this share, contrasts explain what positions of views do: of four data sets with all moderate errors and three views, one was brought
/// to positions whose Dice is .29 instead of .87.
const CONTRAST: f64 = 0.1;
/// Standard deviation of mean contrasts that images do not determine: far smaller than any difference of contrasts that matters. It is as
/// small as the tests of calibration ask.
const MEAN_CONTRAST: f64 = 2.5e-4;
/// Minimum contrast of a frame: images are divided by it.
const MIN_CONTRAST: f64 = 0.3;
/// Maximum step of a translation, mm.
const LONGEST_STEP_MM: f64 = 4.0;
/// Maximum step of an angle, degrees.
const LONGEST_STEP_DEG: f64 = 2.0;
/// Number of sharp residuals that count as one: they are errors of the model, correlated between neighbours, more than noise. With 3 and
/// 1, errors in noise are .26 and .34 pixels instead of .19 (docs/tried.md).
pub const TEMPER: f64 = 10.0;

/// One unknown parameter.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Unknown {
    /// View, and its primary (0) or secondary (1) angle, degrees.
    Angle(usize, usize),
    /// View, and its position along an axis of the C-arm as stated, world units.
    Shift(usize, usize),
    /// View and phase, and the displacement of the heart along an axis of the world, world units.
    Heart(usize, usize, usize),
    /// View and phase whose relative contrast is sought.
    Gain(usize, usize),
}

impl Unknown {
    /// Returns the unknowns of a view.
    pub fn of_view(v: usize) -> [Unknown; 5] {
        use Unknown::{Angle, Shift};
        [Angle(v, 0), Angle(v, 1), Shift(v, 0), Shift(v, 1), Shift(v, 2)]
    }

    /// Returns the standard deviation of its prior.
    pub fn deviation(self) -> f64 {
        match self {
            Unknown::Angle(..) => ANGLE_DEG,
            Unknown::Shift(_, 2) => DEPTH_MM / MM_PER_UNIT,
            Unknown::Shift(..) => ACROSS_MM / MM_PER_UNIT,
            Unknown::Heart(_, _, axis) => HEART_MM[axis] / MM_PER_UNIT,
            Unknown::Gain(..) => CONTRAST,
        }
    }

    /// Tells whether a wrong tag may put it off by any amount. Images hardly determine positions along a view, so these are none.
    fn may_be_far_off(self) -> bool {
        matches!(self, Unknown::Angle(..) | Unknown::Shift(_, 0 | 1))
    }

    fn longest_step(self) -> f64 {
        match self {
            Unknown::Angle(..) => LONGEST_STEP_DEG,
            Unknown::Shift(..) | Unknown::Heart(..) => LONGEST_STEP_MM / MM_PER_UNIT,
            Unknown::Gain(..) => f64::INFINITY,
        }
    }

    /// Returns its value; `axes` are those of the views' C-arms.
    fn value(self, axes: &[DMat3], poses: &Poses) -> f64 {
        match self {
            Unknown::Angle(v, k) => poses.views[v].angles_deg[k],
            Unknown::Shift(v, k) => poses.views[v].shift.dot(axes[v].col(k)),
            Unknown::Heart(v, t, k) => poses.heart[v][t][k],
            Unknown::Gain(v, t) => poses.gains[v][t],
        }
    }

    /// Adds a step to its value; `axes` are those of the views' C-arms.
    pub fn add(self, step: f64, axes: &[DMat3], poses: &mut Poses) {
        match self {
            Unknown::Angle(v, k) => poses.views[v].angles_deg[k] += step,
            Unknown::Shift(v, k) => poses.views[v].shift += step * axes[v].col(k),
            Unknown::Heart(v, t, k) => poses.heart[v][t][k] += step,
            Unknown::Gain(v, t) => poses.gains[v][t] = (poses.gains[v][t] + step).max(MIN_CONTRAST - 1.0),
        }
    }
}

/// Corrections that are sought. Contrasts of frames always are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Freedom {
    /// Positions across the views.
    pub across: bool,
    /// Angles, and positions along the views.
    pub angles_and_depth: bool,
    /// A displacement of the heart in each frame.
    pub heart: bool,
    /// Mean contrast of each phase. Where views are compared with each other, it is unknown: all residuals vanish where all contrasts do. A
    /// field determines all but the mean contrast of all frames.
    pub mean_contrasts: bool,
    /// Errors of angles and of positions across the views have the tails of a Cauchy distribution instead of none.
    pub wrong_tags: bool,
}

impl Freedom {
    /// All that images determine where a field is fixed.
    pub const ALL: Freedom =
        Freedom { across: true, angles_and_depth: true, heart: true, mean_contrasts: true, wrong_tags: false };
    /// Contrasts alone: views and frames stay fixed.
    pub const CONTRASTS: Freedom =
        Freedom { across: false, angles_and_depth: false, heart: false, mean_contrasts: false, wrong_tags: false };

    fn allows(self, unknown: &Unknown) -> bool {
        match unknown {
            Unknown::Shift(_, 0 | 1) => self.across,
            Unknown::Angle(..) | Unknown::Shift(..) => self.angles_and_depth,
            Unknown::Heart(..) => self.heart,
            Unknown::Gain(..) => true,
        }
    }
}

/// All unknowns: those of a view, then those of each of its frames, view by view.
#[derive(Debug)]
pub struct Unknowns {
    /// The unknowns in their order.
    pub all: Vec<Unknown>,
    /// Axes of each view's C-arm as stated, along which its position is measured.
    pub axes: Vec<DMat3>,
    freedom: Freedom,
}

impl Unknowns {
    /// Collects the unknowns of views and of their `frames`, `[view]`: phases.
    pub fn new(axes: Vec<DMat3>, freedom: Freedom, frames: &[Vec<usize>]) -> Unknowns {
        let mut all = Vec::new();
        for (v, phases) in frames.iter().enumerate() {
            all.extend(Unknown::of_view(v));
            for t in phases.iter().copied() {
                all.extend([
                    Unknown::Gain(v, t),
                    Unknown::Heart(v, t, 0),
                    Unknown::Heart(v, t, 1),
                    Unknown::Heart(v, t, 2),
                ]);
            }
        }
        all.retain(|unknown| freedom.allows(unknown));
        Unknowns { all, axes, freedom }
    }

    /// Returns the indices of the unknowns on which a view's frame of a phase depends.
    pub fn of_frame(&self, view: usize, phase: usize) -> Vec<usize> {
        let of_this = |unknown: &Unknown| match *unknown {
            Unknown::Angle(v, _) | Unknown::Shift(v, _) => v == view,
            Unknown::Heart(v, t, _) | Unknown::Gain(v, t) => (v, t) == (view, phase),
        };
        (0..self.all.len()).filter(|i| of_this(&self.all[*i])).collect()
    }

    /// Returns the contrasts by groups whose mean is 1: those of a phase, or all.
    fn even_contrasts(&self) -> BTreeMap<usize, Vec<usize>> {
        let mut groups: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (i, unknown) in self.all.iter().enumerate() {
            let Unknown::Gain(_, phase) = unknown else { continue };
            groups.entry(if self.freedom.mean_contrasts { 0 } else { *phase }).or_default().push(i);
        }
        groups
    }
}

/// Normal equations of a step, for unknowns in standard deviations of their priors.
#[derive(Debug)]
pub struct Normal {
    matrix: Symmetric,
    gradient: Vec<f64>,
}

impl Normal {
    /// Returns equations without residuals, for `n` unknowns.
    pub fn zeros(n: usize) -> Normal {
        Normal { matrix: Symmetric::zeros(n), gradient: vec![0.0; n] }
    }

    /// Adds residuals that depend on the unknowns with these indices. `product` returns the sum of the products of the residuals'
    /// derivatives by two of them, and `gradient` that of the products of derivative and residual; both take positions in `unknowns`, and
    /// derivatives are per standard deviation of the prior.
    pub fn add(&mut self, unknowns: &[usize], product: impl Fn(usize, usize) -> f64, gradient: impl Fn(usize) -> f64) {
        for (k, i) in unknowns.iter().enumerate() {
            self.gradient[*i] += gradient(k);
            unknowns[..=k].iter().enumerate().for_each(|(l, j)| self.matrix.add(*i, *j, product(k, l)));
        }
    }

    /// Adds all residuals of other equations.
    pub fn add_all(&mut self, other: &Normal) {
        self.matrix.add_all(&other.matrix);
        zip(&mut self.gradient, &other.gradient).for_each(|(g, other)| *g += other);
    }

    /// Returns the poses after the step to the most likely corrections, for residuals of this variance; `None` where the equations cannot
    /// be solved. Long steps are shortened.
    pub fn stepped(mut self, variance: f64, unknowns: &Unknowns, poses: &Poses) -> Option<Poses> {
        self.matrix.scale(1.0 / variance);
        self.gradient.iter_mut().for_each(|g| *g /= variance);
        self.add_priors(unknowns, poses);
        let mut step = self.matrix.solve(&self.gradient)?;
        zip(&unknowns.all, &mut step).for_each(|(unknown, step)| *step *= -unknown.deviation());
        let excess = zip(&unknowns.all, &step).map(|(unknown, step)| step.abs() / unknown.longest_step());
        let excess = excess.fold(1.0, f64::max);
        let mut next = poses.clone();
        zip(&unknowns.all, step).for_each(|(unknown, step)| unknown.add(step / excess, &unknowns.axes, &mut next));
        Some(next)
    }

    /// Adds the expected deviations of all corrections from the stated geometry.
    fn add_priors(&mut self, unknowns: &Unknowns, poses: &Poses) {
        let value = |i: usize| unknowns.all[i].value(&unknowns.axes, poses);
        for (i, unknown) in unknowns.all.iter().enumerate() {
            let deviations = value(i) / unknown.deviation();
            let is_cauchy = unknowns.freedom.wrong_tags && unknown.may_be_far_off();
            let weight = if is_cauchy { 1.0 / (1.0 + deviations.powi(2)) } else { 1.0 };
            self.add(&[i], |_, _| weight, |_| weight * deviations);
        }
        for group in unknowns.even_contrasts().values() {
            let of_mean = 1.0 / (group.len() as f64 * MEAN_CONTRAST);
            let (slope, excess) = (CONTRAST * of_mean, of_mean * group.iter().map(|i| value(*i)).sum::<f64>());
            self.add(group, |_, _| slope * slope, |_| slope * excess);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::rotation;
    use glam::DVec3;

    fn unknowns(freedom: Freedom) -> Unknowns {
        Unknowns::new(vec![rotation(30.0, 20.0), rotation(-40.0, 10.0)], freedom, &[vec![0, 2], vec![0, 1, 2]])
    }

    /// Poses with other values of all unknowns.
    fn off(unknowns: &Unknowns) -> Poses {
        let mut poses = Poses::stated(2, 3);
        for (i, unknown) in unknowns.all.iter().enumerate() {
            unknown.add((i as f64 + 1.0).sin() * unknown.deviation(), &unknowns.axes, &mut poses);
        }
        poses
    }

    #[test]
    fn values_follow_steps() {
        let unknowns = unknowns(Freedom::ALL);
        let poses = off(&unknowns);
        for (i, unknown) in unknowns.all.iter().enumerate() {
            let expected = (i as f64 + 1.0).sin() * unknown.deviation();
            assert!((unknown.value(&unknowns.axes, &poses) - expected).abs() < 1e-12, "{unknown:?}");
        }
        assert_eq!(unknowns.all.len(), 2 * 5 + 5 * 4);
        assert_eq!(unknowns.of_frame(1, 1).len(), 5 + 4);
        assert_eq!(self::unknowns(Freedom::CONTRASTS).all.len(), 5);
    }

    #[test]
    fn without_images_the_geometry_is_as_stated() {
        let unknowns = unknowns(Freedom::ALL);
        let next = Normal::zeros(unknowns.all.len()).stepped(1.0, &unknowns, &off(&unknowns)).unwrap();
        for unknown in &unknowns.all {
            let left = unknown.value(&unknowns.axes, &next);
            assert!(left.abs() < 1e-9, "{unknown:?} is {left}");
        }
    }

    #[test]
    fn wrong_tags_are_found_where_they_may_be_far_off() {
        // Images measure all values as ten deviations, with the error that the prior expects.
        let measured = 10.0;
        let found = |wrong_tags: bool| {
            let unknowns = unknowns(Freedom { wrong_tags, ..Freedom::ALL });
            let mut poses = Poses::stated(2, 3);
            for _ in 0..50 {
                let mut normal = Normal::zeros(unknowns.all.len());
                for (i, unknown) in unknowns.all.iter().enumerate() {
                    let off = unknown.value(&unknowns.axes, &poses) / unknown.deviation() - measured;
                    normal.add(&[i], |_, _| 1.0, |_| off);
                }
                poses = normal.stepped(1.0, &unknowns, &poses).unwrap();
            }
            [0, 2].map(|k| Unknown::Shift(0, k)).map(|u| u.value(&unknowns.axes, &poses) / u.deviation())
        };
        let [across, along] = found(false);
        assert!((across - 5.0).abs() < 0.1 && (along - 5.0).abs() < 0.1, "{across} {along}");
        let [across, along] = found(true);
        assert!(across > 9.5 && (along - 5.0).abs() < 0.1, "{across} {along}");
    }

    #[test]
    fn planted_corrections_are_found() {
        let unknowns = unknowns(Freedom::ALL);
        let mut truth = off(&unknowns);
        let mean = truth.gains.iter().flatten().sum::<f64>() / 5.0;
        unknowns.all.iter().filter(|u| matches!(u, Unknown::Gain(..))).for_each(|u| u.add(-mean, &[], &mut truth));
        let mut normal = Normal::zeros(unknowns.all.len());
        for (i, unknown) in unknowns.all.iter().enumerate() {
            // A measurement of each unknown whose error is far smaller than that of the prior.
            normal.add(&[i], |_, _| 1.0, |_| -unknown.value(&unknowns.axes, &truth) / unknown.deviation());
        }
        let found = normal.stepped(1e-9, &unknowns, &Poses::stated(2, 3)).unwrap();
        for unknown in &unknowns.all {
            let apart = unknown.value(&unknowns.axes, &found) - unknown.value(&unknowns.axes, &truth);
            assert!(apart.abs() < 1e-3 * unknown.deviation(), "{unknown:?} is off by {apart}");
        }
    }

    #[test]
    fn mean_contrasts_stay_where_images_do_not_determine_them() {
        for mean_contrasts in [false, true] {
            let unknowns = unknowns(Freedom { mean_contrasts, ..Freedom::CONTRASTS });
            let mut normal = Normal::zeros(unknowns.all.len());
            // Images of phase 0 ask for a contrast of 1.1, the others for one of 1.4.
            for (i, unknown) in unknowns.all.iter().enumerate() {
                let Unknown::Gain(_, phase) = unknown else { continue };
                normal.add(&[i], |_, _| 1.0, |_| if *phase == 0 { -0.5 } else { -2.0 });
            }
            let gains = normal.stepped(1.0, &unknowns, &Poses::stated(2, 3)).unwrap().gains;
            let of_phase = gains[0][0] + gains[1][0];
            let all: f64 = gains.iter().flatten().sum();
            assert!(all.abs() < 1e-2, "{gains:?}");
            assert_eq!(of_phase.abs() < 1e-2, !mean_contrasts, "{gains:?}");
        }
    }

    #[test]
    fn long_steps_are_shortened() {
        let unknowns = unknowns(Freedom::ALL);
        let mut poses = Poses::stated(2, 3);
        poses.views[0].shift = DVec3::splat(20.0 / MM_PER_UNIT);
        poses.views[1].angles_deg[1] = 1.0;
        let next = Normal::zeros(unknowns.all.len()).stepped(1.0, &unknowns, &poses).unwrap();
        let moved = unknowns.axes[0].transpose() * (next.views[0].shift - poses.views[0].shift) * MM_PER_UNIT;
        assert!((moved.abs().max_element() - LONGEST_STEP_MM).abs() < 1e-9, "{moved}");
        assert!((0.5..1.0).contains(&next.views[1].angles_deg[1]), "all parts of a step are shortened alike");
    }
}
