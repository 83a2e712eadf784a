//! Views of known blobs, for tests.

use crate::calibrate::pose::StatedView;
use crate::calibrate::profiles::{Moving, Views};
use crate::geometry::{CArm, Geometry};
use glam::DVec3;

pub(crate) const SIZE: [usize; 2] = [40, 36];
pub(crate) const PHASES: usize = 3;
pub(crate) const ANGLES: [(f64, f64); 3] = [(-30.0, 20.0), (45.0, -15.0), (80.0, 25.0)];

/// Exact line integrals of blobs that move over three phases, seen from nearby by views at the given angles and with
/// tables off centre; the last view has other pixels.
pub(crate) fn views(angles: &[(f64, f64)]) -> Views {
    let blob = |k: usize, t: usize| {
        let (a, b) = (1.3 * k as f64 + 0.4 * t as f64, 2.1 * k as f64 - 0.3 * t as f64);
        DVec3::new(0.05 * a.sin(), 0.05 * b.cos(), 0.05 * (a + b).sin())
    };
    let view = |(v, (primary_deg, secondary_deg)): (usize, &(f64, f64))| {
        let last = v + 1 == angles.len();
        let geometry = Geometry::CArm(CArm {
            primary_deg: *primary_deg,
            secondary_deg: *secondary_deg,
            sid_mm: if last { 350.0 } else { 320.0 },
            sod_mm: 200.0,
            pixel_mm: if last { [1.1, 1.2] } else { [1.0; 2] },
            offset_mm: [1.0, -1.0],
            table_mm: [1.0, -1.0, 0.5 * v as f64],
        });
        let rays = geometry.rays(SIZE[0], SIZE[1]).unwrap();
        let image = |t: usize| {
            let value = |p: usize| {
                let (anchor, d) = rays.pixel((p % SIZE[0]) as f64, (p / SIZE[0]) as f64);
                let far = |x: DVec3| (x - anchor).reject_from(d).length_squared();
                (0..5).map(|k| (-far(blob(k, t)) / (2.0 * 0.012f64.powi(2))).exp()).sum::<f64>() as f32
            };
            Some((0..SIZE[0] * SIZE[1]).map(value).collect::<Vec<f32>>())
        };
        let images: Vec<_> = (0..PHASES).map(image).collect();
        Moving::new(StatedView::new(&geometry, &rays), SIZE, &vec![true; SIZE[0] * SIZE[1]], &images)
    };
    Views::new(angles.iter().enumerate().map(view).collect(), PHASES)
}
