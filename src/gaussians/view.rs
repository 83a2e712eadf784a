//! A cone-beam view in the Gaussians' units: lengths are pixels at the isocentre.

use crate::gaussians::field::Units;
use crate::geometry::ViewRays;
use crate::kernels::layout;
use glam::{DMat3, DVec3};

/// Rays and projection of a view.
#[derive(Debug, Clone, PartialEq)]
pub struct SplatView {
    /// Rows that give depth, depth times column and depth times row of `x + (0, 0, 0, 1)`.
    pub rows: [DVec3; 3],
    /// Constant terms of these rows.
    pub offsets: [f64; 3],
    /// Direction of pixel (0, 0)'s ray, of unit depth, and its change per column and row.
    pub direction: [DVec3; 3],
    /// The X-ray source.
    pub source: DVec3,
    /// Time of the image after its phase, in phases from -0.5 to 0.5. A deformable set is interpolated towards the next or the
    /// previous phase.
    pub after_phase: f64,
}

impl SplatView {
    /// Returns the view, at a phase, whose rays are given in world units.
    pub fn new(rays: &ViewRays, units: Units) -> SplatView {
        SplatView::of(rays.direction, rays.source() / units.pixel, 0.0)
    }

    fn of(direction: [DVec3; 3], source: DVec3, after_phase: f64) -> SplatView {
        let inverse = DMat3::from_cols(direction[0], direction[1], direction[2]).inverse();
        let rows = [0, 1, 2].map(|k| inverse.row(k));
        SplatView { rows, offsets: rows.map(|row| -row.dot(source)), direction, source, after_phase }
    }

    /// Returns the view whose pixels, and unit of length, are `factor` times as wide.
    pub fn coarser(&self, factor: f64) -> SplatView {
        let [_, du, dv] = self.direction;
        let middle = 0.5 * (factor - 1.0);
        SplatView::of([self.ray(middle, middle), du * factor, dv * factor], self.source / factor, self.after_phase)
    }

    /// Returns depth, column and row of a point.
    pub fn project(&self, x: DVec3) -> (f64, f64, f64) {
        let [z, u, v] = [0, 1, 2].map(|k| self.rows[k].dot(x) + self.offsets[k]);
        (z, u / z, v / z)
    }

    /// Returns the direction of a pixel's ray, of unit depth.
    pub fn ray(&self, column: f64, row: f64) -> DVec3 {
        self.direction[0] + column * self.direction[1] + row * self.direction[2]
    }

    /// Returns 1 / |det (d0, du, dv)|: pixels per unit of solid angle.
    pub fn inverse_det(&self) -> f64 {
        let [d0, du, dv] = self.direction;
        1.0 / d0.dot(du.cross(dv)).abs()
    }

    /// Returns the view in f32, for the device.
    pub fn to_device(&self) -> layout::GaussianView {
        let pack = |v: DVec3, w: f64| [v.x as f32, v.y as f32, v.z as f32, w as f32];
        let row = |k: usize| pack(self.rows[k], self.offsets[k]);
        let [d0, du, dv] = self.direction;
        layout::GaussianView {
            depth: row(0),
            column: row(1),
            row: row(2),
            d0: pack(d0, self.inverse_det()),
            du: pack(du, self.after_phase),
            dv: pack(dv, 0.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CArm, Geometry};

    #[test]
    fn points_land_where_rays_come_from() {
        let geometry = Geometry::CArm(CArm {
            primary_deg: -30.0,
            secondary_deg: 25.0,
            sid_mm: 1000.0,
            sod_mm: 700.0,
            pixel_mm: [0.5, 0.6],
            offset_mm: [2.0, -1.0],
            table_mm: [0.0; 3],
        });
        let rays = geometry.rays(64, 48).unwrap();
        let units = Units { pixel: 0.0035, strongest: 0.1 };
        let view = SplatView::new(&rays, units);
        let x = DVec3::new(0.05, -0.03, 0.02);
        let (i, j) = rays.project(x).unwrap();
        let (z, u, v) = view.project(x / units.pixel);
        assert!((u - i).abs() < 1e-9 && (v - j).abs() < 1e-9);
        assert!((view.source + view.ray(u, v) * z - x / units.pixel).length() < 1e-9);
        // The middle of the first of these wide pixels is that of the first 4 x 4 pixels.
        let (_, wide_u, wide_v) = view.coarser(4.0).project(x / units.pixel / 4.0);
        assert!((4.0 * wide_u + 1.5 - u).abs() < 1e-9 && (4.0 * wide_v + 1.5 - v).abs() < 1e-9);
    }
}
