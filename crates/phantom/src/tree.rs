//! Moving coronary tree: procedural, or [read from a file](super::tree_file).
//!
//! Positions are patient mm (LPS), isocentre at the origin. Lumen diameters follow Dodge et al., "Lumen
//! diameter of normal human coronary arteries", Circulation 86:232-246 (1992): left main 4.5 mm, proximal
//! LAD 3.7 mm, distal LAD 1.9 mm, proximal LCx 3.4 mm, first diagonal and marginals about 2.2 mm,
//! septals about 1.2 mm.

use crate::random::{STREAM_SHAPE, uniform01};
use crate::scan::gating::contraction;
use glam::DVec3;

/// A vessel as a polyline.
#[derive(Debug, Clone, PartialEq)]
pub struct Branch {
    /// Anatomical name.
    pub name: String,
    /// Points, LPS mm.
    pub points: Vec<DVec3>,
    /// Lumen radius at each point, mm.
    pub radius_mm: Vec<f64>,
    /// Contrast filling at each point, 0 to 1.
    pub filling: Vec<f64>,
}

/// A tree at one time of the beat.
#[derive(Debug, Clone)]
pub struct Tree {
    /// All vessels.
    pub branches: Vec<Branch>,
}

/// Direction of the heart's displacement in systole: to the front, right and up; LPS.
const SWING: DVec3 = DVec3::new(-0.35, -0.85, 0.4);

/// A beating heart as an ellipsoid of revolution; it gives the position of surface points at a contraction.
#[derive(Debug, Clone)]
pub struct Heart {
    centre: DVec3,
    axis: DVec3,
    front: DVec3,
    side: DVec3,
    /// Half length from base to apex, mm.
    pub long_mm: f64,
    /// Radius at the equator, mm.
    pub short_mm: f64,
}

impl Heart {
    /// Makes a left ventricle with its epicardium around `centre`, scaled by `scale`.
    pub fn new(centre: DVec3, scale: f64) -> Heart {
        // The apex points to the left, front and down; LPS.
        let axis = DVec3::new(0.62, -0.58, -0.53).normalize();
        let front = (DVec3::new(-0.25, -1.0, 0.15) - axis * axis.dot(DVec3::new(-0.25, -1.0, 0.15))).normalize();
        Heart { centre, axis, front, side: front.cross(axis), long_mm: 52.0 * scale, short_mm: 33.0 * scale }
    }

    /// Point of the wall. `along`: 0 at the base, 1 at the apex; `around`: radians from the anterior groove to the lateral
    /// wall; `depth`: 1 on the epicardium, smaller inside; `squeeze`: see [`contraction`].
    pub fn point(&self, along: f64, around: f64, depth: f64, squeeze: f64) -> DVec3 {
        let polar = along * std::f64::consts::FRAC_PI_2 * 0.96;
        let twist = squeeze * (12f64.to_radians() * along - 4f64.to_radians() * (1.0 - along));
        // The base descends, the wall moves inwards, and the whole heart moves forward.
        let radial = 1.0 - squeeze * (0.17 - 0.05 * along);
        let descent = squeeze * 0.20 * (1.0 - along) * self.long_mm;
        let swing = squeeze * self.swing_mm();
        let angle = around + twist;
        let out = self.front * angle.cos() + self.side * angle.sin();
        self.centre
            + self.axis * ((polar.sin() - 0.45) * self.long_mm * (0.5 + 0.5 * depth) + descent)
            + out * (polar.cos() * self.short_mm * depth * radial)
            + SWING * swing
    }

    /// Displacement of the whole heart at full contraction, mm.
    fn swing_mm(&self) -> f64 {
        0.15 * self.short_mm
    }

    /// Tells whether a point lies in the wall or chamber at a contraction.
    pub fn contains(&self, point: DVec3, squeeze: f64) -> bool {
        let p = point - self.centre - SWING * (squeeze * self.swing_mm());
        let along = p.dot(self.axis) / self.long_mm + 0.45;
        if along > 1.0 {
            return false;
        }
        let radial = self.short_mm * 1.25 * (1.0 - squeeze * 0.12);
        let across = (p - self.axis * p.dot(self.axis)).length();
        // Atria continue the ventricle beyond the base.
        let profile =
            if along > 0.0 { (1.0 - along * along).sqrt() } else { (1.0 - (along / 0.9).powi(2)).max(0.0).sqrt() };
        across < radial * profile
    }
}

/// Course of a vessel on the heart: control points (along, around in degrees, depth).
struct Course {
    name: &'static str,
    diameter_mm: (f64, f64),
    controls: &'static [[f64; 3]],
}

const COURSES: &[Course] = &[
    Course {
        name: "LM",
        diameter_mm: (4.5, 4.3),
        controls: &[[-0.22, -8.0, 0.70], [-0.10, 6.0, 0.92], [0.02, 18.0, 1.0]],
    },
    Course {
        name: "LAD",
        diameter_mm: (3.7, 1.7),
        controls: &[
            [0.02, 18.0, 1.0],
            [0.12, 8.0, 1.03],
            [0.28, 3.0, 1.03],
            [0.48, 6.0, 1.03],
            [0.68, 1.0, 1.03],
            [0.86, 5.0, 1.02],
            [0.99, -10.0, 1.02],
        ],
    },
    Course {
        name: "LCx",
        diameter_mm: (3.4, 1.8),
        controls: &[
            [0.02, 18.0, 1.0],
            [0.0, 45.0, 1.04],
            [0.03, 80.0, 1.04],
            [0.06, 115.0, 1.04],
            [0.10, 150.0, 1.03],
            [0.16, 172.0, 1.02],
        ],
    },
    Course {
        name: "D1",
        diameter_mm: (2.2, 1.2),
        controls: &[[0.20, 5.5, 1.03], [0.32, 22.0, 1.04], [0.50, 34.0, 1.03], [0.72, 40.0, 1.02]],
    },
    Course {
        name: "D2",
        diameter_mm: (1.9, 1.1),
        controls: &[[0.44, 5.6, 1.03], [0.55, 20.0, 1.03], [0.72, 28.0, 1.03], [0.88, 34.0, 1.02]],
    },
    Course {
        name: "OM1",
        diameter_mm: (2.2, 1.2),
        controls: &[[0.01, 62.0, 1.04], [0.18, 68.0, 1.04], [0.42, 74.0, 1.03], [0.70, 68.0, 1.02]],
    },
    Course {
        name: "OM2",
        diameter_mm: (2.0, 1.1),
        controls: &[[0.05, 105.0, 1.04], [0.22, 112.0, 1.04], [0.45, 116.0, 1.03], [0.66, 108.0, 1.02]],
    },
    Course {
        name: "S1",
        diameter_mm: (1.3, 0.9),
        controls: &[[0.16, 7.0, 1.02], [0.25, -8.0, 0.92], [0.40, -22.0, 0.80]],
    },
    Course {
        name: "S2",
        diameter_mm: (1.2, 0.9),
        controls: &[[0.36, 4.0, 1.02], [0.45, -8.0, 0.92], [0.58, -20.0, 0.80]],
    },
];

impl Tree {
    /// Makes a left coronary tree on a beating heart, at a fraction of the beat. `scale` scales the anatomy; `seed` varies the
    /// courses of vessels by a few degrees and the contrast along them.
    pub fn procedural(heart: &Heart, scale: f64, fraction: f64, seed: u32) -> Tree {
        let squeeze = contraction(fraction);
        let branches = COURSES
            .iter()
            .enumerate()
            .map(|(index, course)| {
                let b = index as u32;
                let random = |k: u32| 2.0 * uniform01(seed, STREAM_SHAPE, b, k) - 1.0;
                let steps = 30 * (course.controls.len() - 1);
                // The variation vanishes at the start of a branch, so that branches stay attached.
                let (wave, phase) = (2.0 + 1.2 * random(0), std::f64::consts::PI * random(1));
                let amplitude = (2.0 + random(2)).to_radians();
                let at = |i: usize| {
                    let s = i as f64 / steps as f64;
                    let [along, around, depth] = spline(course.controls, s);
                    let sway = amplitude * (s * 4.0).min(1.0) * (std::f64::consts::TAU * wave * s + phase).sin();
                    (along, around.to_radians() + sway, depth)
                };
                let point = |i: usize| {
                    let (along, around, depth) = at(i);
                    heart.point(along, around, depth, squeeze)
                };
                let share = |i: usize| i as f64 / steps as f64;
                let (d0, d1) = course.diameter_mm;
                Branch {
                    name: course.name.to_owned(),
                    points: (0..=steps).map(point).collect(),
                    radius_mm: (0..=steps).map(|i| 0.5 * scale * (d0 + (d1 - d0) * share(i))).collect(),
                    // Contrast decreases towards the periphery, with a slow variation along the vessel.
                    filling: (0..=steps)
                        .map(|i| 0.92 - 0.14 * share(i) + 0.08 * (5.0 * share(i) + 2.0 * random(3)).sin())
                        .collect(),
                }
            })
            .collect();
        Tree { branches }
    }

    /// Bounding box of the tree, including radii.
    pub fn bounds(&self) -> Bounds {
        let points = self.branches.iter().flat_map(|b| b.points.iter().zip(&b.radius_mm));
        let boxes = points.map(|(p, r)| Bounds { low_mm: *p - *r, high_mm: *p + *r });
        boxes.fold(Bounds::EMPTY, Bounds::joined)
    }

    /// First point of the first branch, LPS mm.
    pub fn ostium_mm(&self) -> Option<DVec3> {
        self.branches.first()?.points.first().copied()
    }
}

/// Box along the patient's axes, LPS mm.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Lower corner.
    pub low_mm: DVec3,
    /// Upper corner.
    pub high_mm: DVec3,
}

impl Bounds {
    /// Box that contains nothing.
    pub(super) const EMPTY: Bounds = Bounds { low_mm: DVec3::INFINITY, high_mm: DVec3::NEG_INFINITY };

    /// Smallest box that contains both.
    pub fn joined(self, other: Bounds) -> Bounds {
        Bounds { low_mm: self.low_mm.min(other.low_mm), high_mm: self.high_mm.max(other.high_mm) }
    }

    /// Bounding box of a tree over all phases of its beat; `at` returns the tree at a fraction.
    pub fn over_the_beat(n_phases: u32, at: impl Fn(f64) -> Tree) -> Bounds {
        let boxes = (0..n_phases).map(|p| at(f64::from(p) / f64::from(n_phases)).bounds());
        boxes.fold(Bounds::EMPTY, Bounds::joined)
    }
}

/// Catmull-Rom spline through the control points, at `s` in [0, 1].
pub(super) fn spline(controls: &[[f64; 3]], s: f64) -> [f64; 3] {
    let last = controls.len() - 1;
    let x = s * last as f64;
    let i = (x as usize).min(last - 1);
    let t = x - i as f64;
    let p = |k: isize| controls[k.clamp(0, last as isize) as usize];
    let (a, b, c, d) = (p(i as isize - 1), p(i as isize), p(i as isize + 1), p(i as isize + 2));
    std::array::from_fn(|k| {
        let (m0, m1) = (0.5 * (c[k] - a[k]), 0.5 * (d[k] - b[k]));
        let (t2, t3) = (t * t, t * t * t);
        (2.0 * t3 - 3.0 * t2 + 1.0) * b[k] + (t3 - 2.0 * t2 + t) * m0 + (3.0 * t2 - 2.0 * t3) * c[k] + (t3 - t2) * m1
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_beat_closes_and_moves() {
        assert!(contraction(0.0) < 1e-12 && (contraction(0.35) - 1.0).abs() < 1e-12 && contraction(0.8) < 1e-12);
        let at = |fraction| Tree::procedural(&Heart::new(DVec3::ZERO, 1.0), 1.0, fraction, 1);
        let (begin, systole) = (at(0.0), at(0.3));
        // Measured coronary motion: a few mm at the apex to 15 mm at the base.
        for (branch, later) in begin.branches.iter().zip(&systole.branches) {
            let moved = branch.points.iter().zip(&later.points).map(|(a, b)| a.distance(*b));
            let mean = moved.sum::<f64>() / branch.points.len() as f64;
            println!("{} {mean:.1} mm", branch.name);
            assert!((3.0..16.0).contains(&mean), "{} moves {mean} mm", branch.name);
        }
    }

    #[test]
    fn branches_are_attached() {
        for fraction in [0.0, 0.25, 0.5, 0.75] {
            let tree = Tree::procedural(&Heart::new(DVec3::ZERO, 1.0), 1.0, fraction, 3);
            let by_name = |n: &str| tree.branches.iter().find(|b| b.name == n).unwrap();
            for (child, parent) in [
                ("LAD", "LM"),
                ("LCx", "LM"),
                ("D1", "LAD"),
                ("D2", "LAD"),
                ("OM1", "LCx"),
                ("OM2", "LCx"),
                ("S1", "LAD"),
            ] {
                let start = by_name(child).points[0];
                let gap = by_name(parent).points.iter().map(|p| p.distance(start)).fold(f64::MAX, f64::min);
                assert!(gap < 3.5, "{child} starts {gap} mm from {parent} at {fraction} of the beat");
            }
        }
    }
}
