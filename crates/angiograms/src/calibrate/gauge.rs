//! The motion that no image determines: a common motion of all views (method, robustness of geometry, section 3). The
//! minimum corrections are chosen; where the truth is known, the motion can be found.

use crate::calibrate::pose::{Poses, StatedView};
use crate::geometry::{ViewRays, lps_mm_from_world, world_from_lps_mm};
use crate::linear::Symmetric;
use glam::{DAffine3, DMat3, DVec3};
use std::ops::Range;

/// Half side of the cube that represents the heart when poses are compared, as a share of half the field of view.
const HEART_SHARE: f64 = 0.5;

/// Projections of a shift onto the plane across each view's axis, and the inverse of their sum over the views.
struct Across {
    of_view: Vec<DMat3>,
    inverse: DMat3,
}

impl Across {
    fn of(axes: impl Iterator<Item = DVec3>) -> Option<Across> {
        let of_view: Vec<DMat3> = axes.map(|z| DMat3::IDENTITY - DMat3::from_cols(z * z.x, z * z.y, z * z.z)).collect();
        let sum = of_view.iter().fold(DMat3::ZERO, |sum, q| sum + *q);
        (sum.determinant() > 1e-9).then(|| Across { of_view, inverse: sum.inverse() })
    }

    /// Returns the translation closest to all of `shifts`, measured across their views.
    fn common(&self, shifts: impl Iterator<Item = DVec3>) -> DVec3 {
        self.inverse * self.of_view.iter().zip(shifts).map(|(q, s)| *q * s).sum::<DVec3>()
    }
}

/// Removes the common motion from the corrections, so that they are the minimum ones that make the views agree: the mean
/// primary angle, the translation common to all views and, with `breathing`, the common translation of each phase. The
/// consistency of the images does not change.
pub fn fix(stands: &[StatedView], poses: &mut Poses, breathing: bool) {
    let n = stands.len() as f64;
    let mean = poses.views.iter().map(|p| p.angles_deg[0]).sum::<f64>() / n;
    // The primary angle turns about -z.
    let turn = DMat3::from_rotation_z(mean.to_radians());
    for (v, pose) in poses.views.iter_mut().enumerate() {
        let table = stands[v].table();
        pose.angles_deg[0] -= mean;
        pose.shift = turn * (pose.shift + table) - table;
        poses.heart[v].iter_mut().for_each(|s| *s = turn * *s);
    }
    let Some(across) = Across::of(stands.iter().map(|s| s.axes().z_axis)) else { return };
    if breathing {
        for t in 0..poses.heart[0].len() {
            let common = across.common(poses.heart.iter().map(|of_view| of_view[t]));
            poses.heart.iter_mut().for_each(|of_view| of_view[t] -= common);
        }
    }
    let common = across.common(poses.views.iter().map(|p| p.shift));
    poses.views.iter_mut().for_each(|p| p.shift -= common);
}

/// Returns points that represent the heart: the corners and the centre of a cube around the isocentre, for a view with these rays and
/// columns and rows.
pub fn heart_points(rays: &ViewRays, [width, height]: [usize; 2]) -> Vec<DVec3> {
    let pixel = rays.anchor[1].length().min(rays.anchor[2].length());
    let half = HEART_SHARE * 0.5 * pixel * width.min(height) as f64;
    let sign = |k: usize, axis: usize| if k >> axis & 1 == 1 { half } else { -half };
    let corners = (0..8).map(|k| DVec3::new(sign(k, 0), sign(k, 1), sign(k, 2)));
    corners.chain([DVec3::ZERO]).collect()
}

/// Returns the rays of all frames of the views `of` at two sets of poses.
pub fn frame_rays(stands: &[StatedView], of: Range<usize>, [a, b]: [&Poses; 2]) -> Vec<FrameRays> {
    let of_view = |slot: usize| {
        let rays = move |p: &Poses, t: usize| stands[slot].corrected_rays(&p.views[slot], p.heart[slot][t]);
        (0..a.heart[slot].len()).map(move |t| FrameRays { phase: t, truth: rays(a, t), corrected: rays(b, t) })
    };
    of.flat_map(of_view).collect()
}

/// Rays of a training frame by its true and by its corrected geometry.
#[derive(Debug, Clone)]
pub struct FrameRays {
    /// Cardiac phase.
    pub phase: usize,
    /// Rays of the frame by its true geometry.
    pub truth: ViewRays,
    /// Rays of the frame by its corrected geometry.
    pub corrected: ViewRays,
}

/// A rotation about the isocentre and a translation, one for all phases or one for each.
#[derive(Debug, Clone, PartialEq)]
pub struct RigidMotion {
    /// Axis times angle, radians.
    pub rotation: DVec3,
    /// Translation of each phase, world units.
    pub translations: Vec<DVec3>,
}

impl RigidMotion {
    /// No motion.
    pub fn none(n_phases: usize) -> RigidMotion {
        RigidMotion { rotation: DVec3::ZERO, translations: vec![DVec3::ZERO; n_phases] }
    }

    fn turn(&self) -> DMat3 {
        let angle = self.rotation.length();
        if angle == 0.0 { DMat3::IDENTITY } else { DMat3::from_axis_angle(self.rotation / angle, angle) }
    }

    /// Returns the position of a point (world units) at a phase after the motion.
    pub fn carry(&self, point: DVec3, phase: usize) -> DVec3 {
        self.turn() * point + self.translations[phase]
    }

    /// Returns the motion at a phase for points in patient mm (left, posterior, superior).
    pub fn patient_mm(&self, phase: usize) -> DAffine3 {
        let carried = |point_mm: DVec3| lps_mm_from_world(self.carry(world_from_lps_mm(point_mm), phase));
        let origin = carried(DVec3::ZERO);
        let [x, y, z] = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| carried(axis) - origin);
        DAffine3::from_mat3_translation(DMat3::from_cols(x, y, z), origin)
    }

    /// Returns the rays that see a moved object as `rays` see it at rest.
    pub fn carry_rays(&self, rays: &ViewRays, phase: usize) -> ViewRays {
        rays.turned(self.turn(), DVec3::ZERO).moved(-self.translations[phase])
    }

    /// Root mean square of the image distances, pixels, that remain between truth and correction over `points` (world
    /// units).
    pub fn remainder_px(&self, frames: &[FrameRays], points: &[DVec3]) -> f64 {
        let squares = frames.iter().flat_map(|f| points.iter().map(|p| self.distance(f, *p).map_or(0.0, squared)));
        (squares.sum::<f64>() / (frames.len() * points.len()).max(1) as f64).sqrt()
    }

    /// Columns and rows from the true image of a point to its image after the motion; `None` behind a source.
    fn distance(&self, frame: &FrameRays, point: DVec3) -> Option<[f64; 2]> {
        let (truth, seen) = (frame.truth.project(point)?, frame.corrected.project(self.carry(point, frame.phase))?);
        Some([seen.0 - truth.0, seen.1 - truth.1])
    }

    /// Returns the motion after a small step of one parameter: 0 to 2 rotate, the others translate each phase or all.
    fn stepped(&self, number: usize, step: f64, each_phase: bool) -> RigidMotion {
        let mut next = self.clone();
        match number.checked_sub(3) {
            None => next.rotation[number] += step,
            Some(k) if each_phase => next.translations[k / 3][k % 3] += step,
            Some(k) => next.translations.iter_mut().for_each(|t| t[k] += step),
        }
        next
    }
}

fn squared(distance: [f64; 2]) -> f64 {
    distance[0] * distance[0] + distance[1] * distance[1]
}

/// Returns the common motion between true and corrected geometry, by which a reconstruction from the corrected views is
/// displaced against the truth. It brings `points` (world units, spread over the heart) closest to their true images. With
/// `each_phase`, every phase has a translation of its own, as when the heart breathes.
pub fn common_motion(frames: &[FrameRays], points: &[DVec3], n_phases: usize, each_phase: bool) -> RigidMotion {
    const STEPS: usize = 5;
    const DIFFERENCE: f64 = 1e-5;
    // The damping keeps parameters fixed that no frame or view determines.
    const DAMPING: f64 = 1e-9;
    let n = if each_phase { 3 + 3 * n_phases } else { 6 };
    let mut motion = RigidMotion::none(n_phases);
    for _ in 0..STEPS {
        let (mut matrix, mut gradient) = (Symmetric::zeros(n), vec![0.0; n]);
        for frame in frames {
            let of_phase = if each_phase { 3 + 3 * frame.phase } else { 3 };
            let numbers: Vec<usize> = (0..3).chain(of_phase..of_phase + 3).collect();
            let moved: Vec<RigidMotion> =
                numbers.iter().map(|number| motion.stepped(*number, DIFFERENCE, each_phase)).collect();
            for point in points {
                let Some(here) = motion.distance(frame, *point) else { continue };
                let slope = |m: &RigidMotion| {
                    let there = m.distance(frame, *point).unwrap_or(here);
                    [0, 1].map(|k| (there[k] - here[k]) / DIFFERENCE)
                };
                let slopes: Vec<[f64; 2]> = moved.iter().map(slope).collect();
                let dot = |a: [f64; 2], b: [f64; 2]| a[0] * b[0] + a[1] * b[1];
                for (k, i) in numbers.iter().enumerate() {
                    gradient[*i] += dot(slopes[k], here);
                    numbers[..=k].iter().enumerate().for_each(|(l, j)| matrix.add(*i, *j, dot(slopes[k], slopes[l])));
                }
            }
        }
        let size = gradient.len() as f64;
        (0..n).for_each(|i| matrix.add(i, i, DAMPING * size));
        let Some(step) = matrix.solve(&gradient) else { break };
        for (number, step) in step.into_iter().enumerate() {
            motion = motion.stepped(number, -step, each_phase);
        }
    }
    motion
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::calibrate::samples::{ANGLES, SIZE, views};

    #[test]
    fn a_common_motion_is_found() {
        let views = views(&ANGLES);
        let motion = RigidMotion {
            rotation: DVec3::new(0.01, -0.02, 0.015),
            translations: vec![DVec3::new(0.01, 0.0, -0.02), DVec3::new(0.0, 0.01, 0.0), DVec3::ZERO],
        };
        let points = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, DVec3::NEG_X, DVec3::ONE].map(|p| p * 0.1);
        let frame = |(v, phase): (usize, usize)| {
            let truth = views.views[v].stand.rays.clone();
            FrameRays { phase, corrected: motion.carry_rays(&truth, phase), truth }
        };
        let frames: Vec<FrameRays> = (0..9).map(|k| frame((k / 3, k % 3))).collect();
        let found = common_motion(&frames, &points, 3, true);
        assert!((found.rotation - motion.rotation).length() < 1e-6, "{found:?}");
        for (a, b) in found.translations.iter().zip(&motion.translations) {
            assert!((*a - *b).length() < 1e-6, "{found:?}");
        }
        assert!(found.remainder_px(&frames, &points) < 1e-4);
        // The motion in patient millimetres must agree.
        let place_mm = DVec3::new(12.0, -34.0, 56.0);
        let away = motion.patient_mm(1).transform_point3(place_mm)
            - lps_mm_from_world(motion.carry(world_from_lps_mm(place_mm), 1));
        assert!(away.length() < 1e-9, "{away}");
        assert!(RigidMotion::none(3).remainder_px(&frames, &points) > 0.02 * SIZE[0] as f64);
    }
}
