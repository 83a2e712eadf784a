//! Geometry of the views: as stated, and corrected by two angles and a translation per view and a shift per frame.

use crate::geometry::{Geometry, ViewRays, angles_deg_of, rotation, world_from_lps_mm};
use glam::{DMat3, DVec3};

/// A view with its stated geometry.
#[derive(Debug, Clone)]
pub struct StatedView {
    /// Rays of the images, as stated.
    pub rays: ViewRays,
    angles_deg: [f64; 2],
    /// Rotation from the C-arm's axes to the world's; its third column points from the source to the detector.
    axes: DMat3,
    table: DVec3,
}

/// Corrections of a view.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ViewPose {
    /// Correction added to the primary and the secondary angle, degrees.
    pub angles_deg: [f64; 2],
    /// Displacement of the patient in the room beyond the stated one, world units.
    pub shift: DVec3,
}

/// Corrections of all views and frames.
#[derive(Debug, Clone, PartialEq)]
pub struct Poses {
    /// Correction of each view.
    pub views: Vec<ViewPose>,
    /// `[view][phase]`: displacement of the heart by breathing, world units.
    pub heart: Vec<Vec<DVec3>>,
    /// `[view][phase]`: relative excess of a frame's contrast over the others; a nuisance parameter.
    pub gains: Vec<Vec<f64>>,
}

impl Poses {
    /// Returns poses without corrections.
    pub fn stated(n_views: usize, n_phases: usize) -> Poses {
        Poses {
            views: vec![ViewPose::default(); n_views],
            heart: vec![vec![DVec3::ZERO; n_phases]; n_views],
            gains: vec![vec![0.0; n_phases]; n_views],
        }
    }
}

impl StatedView {
    /// Creates a view whose images have these rays. A projection matrix is treated as a C-arm with the same viewing
    /// direction.
    pub fn new(geometry: &Geometry, rays: &ViewRays) -> StatedView {
        let (angles_deg, table) = match geometry {
            Geometry::CArm(c) => ([c.primary_deg, c.secondary_deg], world_from_lps_mm(DVec3::from_array(c.table_mm))),
            Geometry::Matrix(_) => (angles_deg_of(rays.axis()), DVec3::ZERO),
        };
        StatedView { rays: rays.clone(), angles_deg, axes: rotation(angles_deg[0], angles_deg[1]), table }
    }

    /// Displacement of the patient by the table, world units.
    pub fn table(&self) -> DVec3 {
        self.table
    }

    /// Axes of the C-arm as stated: across columns, across rows, from the source to the detector.
    pub fn axes(&self) -> DMat3 {
        self.axes
    }

    /// Axes of the corrected C-arm.
    pub fn corrected_axes(&self, pose: &ViewPose) -> DMat3 {
        rotation(self.angles_deg[0] + pose.angles_deg[0], self.angles_deg[1] + pose.angles_deg[1])
    }

    /// Rotation of directions by the correction of the view.
    pub fn turn(&self, pose: &ViewPose) -> DMat3 {
        self.corrected_axes(pose) * self.axes.transpose()
    }

    /// Corrected source in the room, before displacements of table and patient; the correction rotates it about the
    /// isocentre.
    pub fn source_in_room(&self, pose: &ViewPose) -> DVec3 {
        self.turn(pose) * (self.rays.source() + self.table)
    }

    /// Corrected source in the patient's coordinates.
    pub fn source(&self, pose: &ViewPose) -> DVec3 {
        self.source_in_room(pose) - self.table - pose.shift
    }

    /// World axes about which the view rotates when the primary and the secondary angle increase.
    pub fn turning_axes(&self, pose: &ViewPose) -> [DVec3; 2] {
        let (sin, cos) = (self.angles_deg[0] + pose.angles_deg[0]).to_radians().sin_cos();
        [-DVec3::Z, DVec3::new(sin, cos, 0.0)]
    }

    /// Rays of the corrected view, with the patient displaced by a further `heart`.
    pub fn corrected_rays(&self, pose: &ViewPose, heart: DVec3) -> ViewRays {
        self.rays.turned(self.turn(pose), self.table).moved(pose.shift + heart)
    }

    /// Distance of the source from the isocentre, world units.
    pub fn sod(&self) -> f64 {
        (self.rays.source() + self.table).length()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CArm;

    fn c_arm() -> CArm {
        CArm {
            primary_deg: 35.0,
            secondary_deg: -20.0,
            sid_mm: 1100.0,
            sod_mm: 750.0,
            pixel_mm: [0.5, 0.7],
            offset_mm: [3.0, -2.0],
            table_mm: [12.0, -7.0, 25.0],
        }
    }

    /// Rays as a list of numbers.
    fn numbers(rays: &ViewRays) -> Vec<f64> {
        rays.anchor.iter().chain(&rays.direction).flat_map(|v| v.to_array()).chain([rays.sod]).collect()
    }

    #[test]
    fn a_correction_is_a_c_arm() {
        let stated = Geometry::CArm(c_arm());
        let pose = ViewPose { angles_deg: [0.7, -0.4], shift: DVec3::new(0.01, -0.02, 0.03) };
        let stand = StatedView::new(&stated, &stated.rays(64, 48).unwrap());
        let corrected = stated.corrected(pose.angles_deg, pose.shift);
        let (want, got) = (corrected.rays(64, 48).unwrap(), stand.corrected_rays(&pose, DVec3::ZERO));
        for (a, b) in numbers(&want).iter().zip(numbers(&got)) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
        assert!((stand.source(&pose) - want.source()).length() < 1e-12);
    }

    #[test]
    fn a_matrix_is_corrected_like_its_c_arm() {
        let stated = Geometry::CArm(CArm { table_mm: [0.0; 3], ..c_arm() });
        let (angles, shift) = ([0.7, -0.4], DVec3::new(0.01, -0.02, 0.03));
        let rays = stated.rays(64, 48).unwrap();
        let matrix = crate::geometry::tests::matrix_of(&rays);
        let want = stated.corrected(angles, shift).rays(64, 48).unwrap();
        let got = matrix.corrected(angles, shift).rays(64, 48).unwrap();
        for point in [DVec3::ZERO, DVec3::new(0.2, -0.1, 0.15), DVec3::new(-0.1, 0.3, -0.2)] {
            let (a, b) = (want.project(point).unwrap(), got.project(point).unwrap());
            assert!((a.0 - b.0).abs() < 1e-8 && (a.1 - b.1).abs() < 1e-8, "{a:?} {b:?}");
        }
    }

    #[test]
    fn angles_are_those_of_the_axis() {
        for (p, s) in [(30.0, 20.0), (-100.0, -40.0), (170.0, 5.0)] {
            let [primary, secondary] = angles_deg_of(rotation(p, s) * DVec3::Z);
            assert!((primary - p).abs() < 1e-9 && (secondary - s).abs() < 1e-9, "{primary} {secondary}");
        }
    }
}
