//! C-arm geometry in f64: pose (degrees, mm) or projection matrix -> rays.
//!
//! World axes are (posterior, left, superior), a left-handed triple in units of 100 mm with the
//! isocentre at the origin: `world = (LPS.y, LPS.x, LPS.z) / 100`. The source stands at
//! `R (0, 0, -SOD)` and pixel `(i, j)` looks along `R (u / SID, v / SID, 1)` with
//! `R = Rz(-primary) Rz(90 deg) Rx(secondary) Rx(-90 deg)`. Directions have unit depth, not unit
//! length; depth is counted from the isocentre plane.

use glam::{DAffine3, DMat3, DVec3};
use serde::{Deserialize, Serialize};

/// One world unit in mm.
pub const MM_PER_UNIT: f64 = 100.0;

/// World point (100 mm; posterior, left, superior) of a patient point in mm (left, posterior, superior).
pub fn world_from_lps_mm(lps: DVec3) -> DVec3 {
    DVec3::new(lps.y, lps.x, lps.z) / MM_PER_UNIT
}

/// Patient vector in mm (left, posterior, superior) of a world vector.
pub fn lps_mm_from_world(world: DVec3) -> DVec3 {
    DVec3::new(world.y, world.x, world.z) * MM_PER_UNIT
}

/// Returns the transform from world units to voxel index of a transform from voxel index to patient mm (LPS).
pub fn world_to_index(index_to_lps: &DAffine3) -> DAffine3 {
    let columns = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| world_from_lps_mm(index_to_lps.matrix3 * axis));
    let index_to_world = DAffine3::from_mat3_translation(
        DMat3::from_cols(columns[0], columns[1], columns[2]),
        world_from_lps_mm(index_to_lps.translation),
    );
    index_to_world.inverse()
}

/// How an image was taken.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(untagged)]
pub enum Geometry {
    /// Angles and distances of a C-arm.
    CArm(CArm),
    /// An explicit projection.
    Matrix(Matrix),
}

/// C-arm angles and distances.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct CArm {
    /// Primary angle in degrees, LAO positive (DICOM PositionerPrimaryAngle).
    pub primary_deg: f64,
    /// Secondary angle in degrees, cranial positive (DICOM PositionerSecondaryAngle).
    pub secondary_deg: f64,
    /// Source to detector, mm.
    pub sid_mm: f64,
    /// Source to isocentre, mm.
    pub sod_mm: f64,
    /// Pixel pitch on the detector along columns and rows, mm.
    pub pixel_mm: [f64; 2],
    /// Offset of the detector centre along columns and rows, mm.
    #[serde(default)]
    pub offset_mm: [f64; 2],
    /// How far the table has carried the patient along (left, posterior, superior), mm, from where patient
    /// coordinates have their origin at the isocentre.
    #[serde(default, skip_serializing_if = "is_at_rest")]
    pub table_mm: [f64; 3],
}

/// Tells whether a displacement is zero.
pub(crate) fn is_at_rest(way_mm: &[f64; 3]) -> bool {
    *way_mm == [0.0; 3]
}

/// A 3 x 4 projection from patient mm (LPS, origin at the isocentre) to homogeneous pixels
/// (column, row; integers are pixel centres).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Matrix {
    /// Row-major entries.
    pub matrix: [[f64; 4]; 3],
}

/// Rays of one view: affine in pixel column `i` and row `j`, in world units.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewRays {
    /// Point of pixel (0, 0)'s ray at the isocentre plane, and its change per column and row.
    pub anchor: [DVec3; 3],
    /// Direction of pixel (0, 0)'s ray (unit depth), and its change per column and row.
    pub direction: [DVec3; 3],
    /// Source to isocentre plane, world units.
    pub sod: f64,
}

/// Rotation of a C-arm at the given angles, degrees.
pub fn rotation(primary_deg: f64, secondary_deg: f64) -> DMat3 {
    DMat3::from_rotation_z(-primary_deg.to_radians())
        * DMat3::from_rotation_z(90f64.to_radians())
        * DMat3::from_rotation_x(secondary_deg.to_radians())
        * DMat3::from_rotation_x((-90f64).to_radians())
}

impl Geometry {
    /// Returns the rays of a `width` x `height` image.
    ///
    /// # Errors
    /// Field and problem, for an impossible geometry.
    pub fn rays(&self, width: usize, height: usize) -> Result<ViewRays, (String, String)> {
        match self {
            Geometry::CArm(carm) => carm.rays(width, height),
            Geometry::Matrix(matrix) => matrix.rays(),
        }
    }

    /// Primary and secondary angle in degrees, where the geometry is stated by angles.
    pub fn angles_deg(&self) -> Option<(f64, f64)> {
        match self {
            Geometry::CArm(c) => Some((c.primary_deg, c.secondary_deg)),
            Geometry::Matrix(_) => None,
        }
    }

    /// Returns this geometry turned by angles (primary and secondary, degrees) about the isocentre, with the patient carried a
    /// further `shift` (world units). A matrix turns like the C-arm with the same viewing direction.
    pub fn corrected(&self, angles_deg: [f64; 2], shift: DVec3) -> Geometry {
        match self {
            Geometry::CArm(c) => {
                let shift_mm = lps_mm_from_world(shift);
                Geometry::CArm(CArm {
                    primary_deg: c.primary_deg + angles_deg[0],
                    secondary_deg: c.secondary_deg + angles_deg[1],
                    table_mm: [0, 1, 2].map(|k| c.table_mm[k] + shift_mm[k]),
                    ..c.clone()
                })
            }
            Geometry::Matrix(matrix) => Geometry::Matrix(matrix.corrected(angles_deg, shift)),
        }
    }
}

/// Angles in degrees, primary and secondary, of the C-arm whose axis from the source to the detector is `axis`.
pub fn angles_deg_of(axis: DVec3) -> [f64; 2] {
    [axis.y.atan2(-axis.x).to_degrees(), axis.z.clamp(-1.0, 1.0).asin().to_degrees()]
}

/// Accepted distances and pixel pitches of a C-arm, mm.
const LENGTHS_MM: std::ops::RangeInclusive<f64> = 1e-4..=1e5;

impl CArm {
    fn rays(&self, width: usize, height: usize) -> Result<ViewRays, (String, String)> {
        let positive = [
            ("sid_mm", self.sid_mm),
            ("sod_mm", self.sod_mm),
            ("pixel_mm[0]", self.pixel_mm[0]),
            ("pixel_mm[1]", self.pixel_mm[1]),
        ];
        for (field, value) in positive {
            if !LENGTHS_MM.contains(&value) {
                return Err((
                    field.into(),
                    format!("{value:?} is not a positive length in mm, from 0.0001 mm to 100 m"),
                ));
            }
        }
        for (field, value) in [("primary_deg", self.primary_deg), ("secondary_deg", self.secondary_deg)] {
            if !(value.is_finite() && value.abs() <= 360.0) {
                return Err((field.into(), format!("{value} is not an angle in degrees")));
            }
        }
        if !self.offset_mm.iter().all(|o| o.is_finite() && o.abs() < 1e4) {
            return Err(("offset_mm".into(), format!("{:?} is not a position on a detector in mm", self.offset_mm)));
        }
        if !self.table_mm.iter().all(|t| t.is_finite() && t.abs() < 1e4) {
            return Err(("table_mm".into(), "is not a position in mm".into()));
        }
        if self.sod_mm >= self.sid_mm {
            return Err((
                "sod_mm".into(),
                format!("{} mm would put the isocentre behind the detector (sid_mm = {})", self.sod_mm, self.sid_mm),
            ));
        }
        let r = rotation(self.primary_deg, self.secondary_deg);
        let u0 = (0.5 - width as f64 / 2.0) * self.pixel_mm[0] + self.offset_mm[0];
        let v0 = (0.5 - height as f64 / 2.0) * self.pixel_mm[1] + self.offset_mm[1];
        let du = r * DVec3::new(self.pixel_mm[0] / self.sid_mm, 0.0, 0.0);
        let dv = r * DVec3::new(0.0, self.pixel_mm[1] / self.sid_mm, 0.0);
        let across = r * DVec3::new(u0 / self.sid_mm, v0 / self.sid_mm, 0.0);
        let direction = [across + r * DVec3::Z, du, dv];
        // Relative to the patient, source and detector move opposite to the table; depth is counted from the patient's origin.
        let table = world_from_lps_mm(DVec3::from_array(self.table_mm));
        let sod = self.sod_mm / MM_PER_UNIT + table.dot(r * DVec3::Z);
        let source = r * DVec3::new(0.0, 0.0, -self.sod_mm / MM_PER_UNIT) - table;
        Ok(ViewRays::at_depth(source, direction, sod))
    }
}

impl Matrix {
    fn rays(&self) -> Result<ViewRays, (String, String)> {
        let field = "matrix".to_owned();
        let m = &self.matrix;
        if !m.iter().flatten().all(|v| v.is_finite()) {
            return Err((field, "has an entry that is not finite".into()));
        }
        // Columns: LPS mm -> world axes (swap x and y).
        let rows = [0, 1, 2].map(|r| DVec3::new(m[r][1], m[r][0], m[r][2]));
        let square = DMat3::from_cols(rows[0], rows[1], rows[2]).transpose();
        let scale = rows.iter().map(|r| r.length()).product::<f64>();
        if square.determinant().abs() <= 1e-9 * scale || scale == 0.0 {
            return Err((field, "its left 3 x 3 part cannot be inverted".into()));
        }
        let inverse = square.inverse();
        let source = -(inverse * DVec3::new(m[0][3], m[1][3], m[2][3])) / MM_PER_UNIT;
        let axis = rows[2].normalize();
        let depth_of_origin = -source.dot(axis);
        if depth_of_origin == 0.0 {
            return Err((field, "puts the source in the isocentre plane".into()));
        }
        // A matrix is defined up to its sign; choose the sign that looks from the source towards the isocentre.
        let scale = rows[2].length() * depth_of_origin.signum();
        let direction = [DVec3::Z, DVec3::X, DVec3::Y].map(|p| inverse * p * scale);
        Ok(ViewRays::at_depth(source, direction, depth_of_origin.abs()))
    }

    /// Implements [`Geometry::corrected`]: the corrected view sees a point where this view sees the point after it is moved and
    /// turned back.
    fn corrected(&self, angles_deg: [f64; 2], shift: DVec3) -> Matrix {
        let Ok(rays) = self.rays() else { return self.clone() };
        let [primary, secondary] = angles_deg_of(rays.axis());
        let turn =
            rotation(primary + angles_deg[0], secondary + angles_deg[1]) * rotation(primary, secondary).transpose();
        // Turn in the patient's axes (left, posterior, superior): the first two axes are exchanged with respect to the world's.
        let back = |row: usize, column: usize| {
            let world = |axis: usize| [1, 0, 2][axis];
            turn.col(world(row))[world(column)]
        };
        let shift_mm = lps_mm_from_world(shift);
        let matrix = self.matrix.map(|m| {
            let row = [0, 1, 2].map(|column| (0..3).map(|k| m[k] * back(k, column)).sum::<f64>());
            [row[0], row[1], row[2], m[3] + row[0] * shift_mm.x + row[1] * shift_mm.y + row[2] * shift_mm.z]
        });
        Matrix { matrix }
    }
}

impl ViewRays {
    fn at_depth(source: DVec3, direction: [DVec3; 3], sod: f64) -> ViewRays {
        let [d0, du, dv] = direction;
        ViewRays { anchor: [source + d0 * sod, du * sod, dv * sod], direction, sod }
    }

    /// Unit vector perpendicular to the detector, pointing from the source to the detector.
    pub fn axis(&self) -> DVec3 {
        let axis = self.direction[1].cross(self.direction[2]).normalize();
        if axis.dot(self.direction[0]) < 0.0 { -axis } else { axis }
    }

    /// Returns the rays that see the patient displaced by `way` (world units).
    pub fn moved(&self, way: DVec3) -> ViewRays {
        if way == DVec3::ZERO {
            return self.clone();
        }
        ViewRays::at_depth(self.source() - way, self.direction, self.sod + way.dot(self.axis()))
    }

    /// Returns the rays of the C-arm turned about the isocentre, where the table has carried the patient's origin away from the
    /// isocentre by `table` (world units).
    pub fn turned(&self, turn: DMat3, table: DVec3) -> ViewRays {
        let source = turn * (self.source() + table) - table;
        let direction = self.direction.map(|d| turn * d);
        ViewRays::at_depth(source, direction, -source.dot(turn * self.axis()))
    }

    /// Returns the rays of an image each of whose pixels covers `factor` x `factor` pixels of this one.
    pub fn binned(&self, factor: usize) -> ViewRays {
        let (middle, f) = (0.5 * (factor as f64 - 1.0), factor as f64);
        let (_, first) = self.pixel(middle, middle);
        ViewRays::at_depth(self.source(), [first, self.direction[1] * f, self.direction[2] * f], self.sod)
    }

    /// Returns the rays through every `step`-th pixel along columns and rows, from the first one on.
    pub fn every(&self, step: usize) -> ViewRays {
        let ([first, column, row], f) = (self.direction, step as f64);
        ViewRays::at_depth(self.source(), [first, column * f, row * f], self.sod)
    }

    /// Returns the rays of an image whose first row is row `first` of this one.
    pub fn from_row(&self, first: usize) -> ViewRays {
        let (anchor, direction) = self.pixel(0.0, first as f64);
        ViewRays {
            anchor: [anchor, self.anchor[1], self.anchor[2]],
            direction: [direction, self.direction[1], self.direction[2]],
            sod: self.sod,
        }
    }

    /// Anchor and direction of pixel `(i, j)`.
    pub fn pixel(&self, i: f64, j: f64) -> (DVec3, DVec3) {
        let at = |p: &[DVec3; 3]| p[0] + i * p[1] + j * p[2];
        (at(&self.anchor), at(&self.direction))
    }

    /// Source position, world units.
    pub fn source(&self) -> DVec3 {
        self.anchor[0] - self.direction[0] * self.sod
    }

    /// Projection matrix from patient mm (left, posterior, superior) to homogeneous pixels (column, row), in row-major order.
    pub fn projection(&self) -> [[f64; 4]; 3] {
        // [B^-1 | -B^-1 s] in world units, whose axes are posterior, left, superior.
        let basis = DMat3::from_cols(self.direction[1], self.direction[2], self.direction[0]).inverse();
        let shift = -(basis * self.source()) * MM_PER_UNIT;
        [0, 1, 2].map(|r| {
            let row = basis.row(r);
            [row.y, row.x, row.z, shift[r]]
        })
    }

    /// Column and row (pixel centres at integers) that a world point projects to; `None` behind the source.
    pub fn project(&self, point: DVec3) -> Option<(f64, f64)> {
        let basis = DMat3::from_cols(self.direction[1], self.direction[2], self.direction[0]);
        let h = basis.inverse() * (point - self.source());
        (h.z > 0.0).then(|| (h.x / h.z, h.y / h.z))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::formats::volume::Volume;

    #[test]
    fn world_axes_are_posterior_left_superior() {
        let volume = Volume::centred([2, 3, 4], 1.5, DVec3::new(1.0, -2.0, 3.0), vec![0.0; 24]);
        // Voxel (0,0,0) sits at LPS (0.25, -3.5, 0.75): world = (P, L, S) / 100.
        let index = world_to_index(&volume.index_to_lps).transform_point3(DVec3::new(-0.035, 0.0025, 0.0075));
        assert!(index.length() < 1e-9, "{index}");
    }

    /// Returns a projection matrix with these rays; its sign can be chosen.
    pub(crate) fn matrix_of(rays: &ViewRays) -> Geometry {
        let matrix = rays.projection().map(|row| row.map(|value| -3.0 * value));
        Geometry::Matrix(Matrix { matrix })
    }

    fn carm(primary_deg: f64, secondary_deg: f64) -> CArm {
        CArm {
            primary_deg,
            secondary_deg,
            sid_mm: 1100.0,
            sod_mm: 750.0,
            pixel_mm: [0.5, 0.7],
            offset_mm: [3.0, -2.0],
            table_mm: [0.0; 3],
        }
    }

    #[test]
    fn a_moved_table_carries_the_patient_along() {
        let mut moved = carm(30.0, 20.0);
        moved.table_mm = [12.0, -7.0, 25.0];
        let (at_rest, moved) = (carm(30.0, 20.0).rays(64, 48).unwrap(), moved.rays(64, 48).unwrap());
        // In the room, a patient point is displaced by the position of the table.
        let point = DVec3::new(5.0, 10.0, -15.0);
        let here = moved.project(world_from_lps_mm(point)).unwrap();
        let there = at_rest.project(world_from_lps_mm(point + DVec3::new(12.0, -7.0, 25.0))).unwrap();
        assert!((here.0 - there.0).abs() < 1e-9 && (here.1 - there.1).abs() < 1e-9);
        // Depth zero is the plane through the patient's origin.
        let axis = rotation(30.0, 20.0) * DVec3::Z;
        assert!(moved.pixel(3.0, 40.0).0.dot(axis).abs() < 1e-12);
    }

    #[test]
    fn lao_looks_from_the_right_back_to_the_left_front() {
        // At 0/0 the beam runs from back to front (posterior = +x), columns grow to the patient's left.
        let rays = carm(0.0, 0.0).rays(10, 10).unwrap();
        let centre = rays.direction[0] + rays.direction[1] * 4.5 + rays.direction[2] * 4.5;
        assert!(centre.x < -0.99, "{centre}");
        assert!(rays.direction[1].y > 0.0 && rays.direction[2].z < 0.0);
        // LAO 90 puts the detector on the patient's left.
        let lao = rotation(90.0, 0.0) * DVec3::Z;
        assert!(lao.y > 0.99, "{lao}");
        // Cranial puts the detector towards the head.
        let cranial = rotation(0.0, 30.0) * DVec3::Z;
        assert!((cranial.z - 0.5).abs() < 1e-12, "{cranial}");
    }

    #[test]
    fn projection_inverts_rays() {
        let rays = carm(-30.0, 25.0).rays(64, 48).unwrap();
        let (anchor, direction) = rays.pixel(17.25, 40.5);
        let (i, j) = rays.project(anchor + direction * 0.3).unwrap();
        assert!((i - 17.25).abs() < 1e-9 && (j - 40.5).abs() < 1e-9);
    }

    #[test]
    fn a_matrix_gives_the_rays_of_its_c_arm() {
        let want = carm(40.0, -20.0).rays(64, 48).unwrap();
        let got = matrix_of(&want).rays(64, 48).unwrap();
        assert!((got.sod - want.sod).abs() < 1e-9);
        for (a, b) in got.direction.iter().zip(&want.direction) {
            assert!((*a - *b).length() < 1e-9, "{a} {b}");
        }
        assert!((got.anchor[0] - want.anchor[0]).length() < 1e-9);
    }

    #[test]
    fn binned_pixels_look_through_the_middle_of_theirs() {
        let (fine, coarse) =
            (carm(40.0, -20.0).rays(64, 48).unwrap(), carm(40.0, -20.0).rays(64, 48).unwrap().binned(4));
        let ((a, b), (c, d)) = (fine.pixel(9.5, 5.5), coarse.pixel(2.0, 1.0));
        assert!((a - c).length() < 1e-12 && (b - d).length() < 1e-12);
    }

    #[test]
    fn impossible_geometry_names_the_field() {
        let mut bad = carm(0.0, 0.0);
        bad.sid_mm = -5.0;
        assert_eq!(bad.rays(4, 4).unwrap_err().0, "sid_mm");
        bad.sid_mm = 700.0;
        assert_eq!(bad.rays(4, 4).unwrap_err().0, "sod_mm");
        // Rays that far from the axis have no place in single precision.
        bad = CArm { offset_mm: [0.0, 1e30], ..carm(0.0, 0.0) };
        assert_eq!(bad.rays(4, 4).unwrap_err().0, "offset_mm");
        assert_eq!(Matrix { matrix: [[1.0, 0.0, 0.0, 0.0]; 3] }.rays().unwrap_err().0, "matrix");
    }
}
