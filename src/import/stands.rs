//! From where the frames of a run were taken: a C-arm or a table that moves gives a run several views.

use crate::geometry::{CArm, Geometry, ViewRays, world_from_lps_mm};
use glam::DVec3;

/// Frames that see points of the heart within so many pixels of each other are of one view.
const SAME_VIEW_PX: f64 = 0.1;
/// Half side of the cube about the isocentre that stands for the heart, mm.
const HEART_MM: f64 = 50.0;

/// Of each frame, the first that was taken from where it was; images have `size` (columns, rows).
pub(super) fn stands(c_arms: &[CArm], size: [usize; 2]) -> Vec<usize> {
    let rays: Vec<Option<ViewRays>> =
        c_arms.iter().map(|c_arm| Geometry::CArm(c_arm.clone()).rays(size[0], size[1]).ok()).collect();
    let same = |a: usize, b: usize| match (&rays[a], &rays[b]) {
        _ if c_arms[a] == c_arms[b] => true,
        (Some(a), Some(b)) => apart_px(a, b) < SAME_VIEW_PX,
        _ => false,
    };
    let mut first: Vec<usize> = Vec::new();
    (0..c_arms.len())
        .map(|frame| {
            first.iter().copied().find(|stand| same(*stand, frame)).unwrap_or_else(|| {
                first.push(frame);
                frame
            })
        })
        .collect()
}

/// How far apart two views see a point of the heart, pixels, at most.
fn apart_px(a: &ViewRays, b: &ViewRays) -> f64 {
    let sign = |k: usize, axis: usize| if k >> axis & 1 == 1 { HEART_MM } else { -HEART_MM };
    let corners = (0..8).map(|k| DVec3::new(sign(k, 0), sign(k, 1), sign(k, 2)));
    let apart = |lps_mm: DVec3| {
        let point = world_from_lps_mm(lps_mm);
        let ((x, y), (u, v)) = a.project(point).zip(b.project(point))?;
        Some((x - u).hypot(y - v))
    };
    corners.map(|corner| apart(corner).unwrap_or(f64::INFINITY)).fold(0.0, f64::max)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn c_arm(primary_deg: f64, table_mm: [f64; 3]) -> CArm {
        CArm {
            primary_deg,
            secondary_deg: 10.0,
            sid_mm: 1000.0,
            sod_mm: 750.0,
            pixel_mm: [0.4; 2],
            offset_mm: [0.0; 2],
            table_mm,
        }
    }

    #[test]
    fn frames_share_a_view_while_nothing_moves_by_more_than_a_tenth_of_a_pixel() {
        // A pixel is 0.3 mm at the isocentre: 0.1 of it are 0.03 mm of the table, or as much at 50 mm and an angle of 0.03 degrees.
        let table: Vec<CArm> = [0.0, 0.015, 2.0, 2.01, 0.01, 4.0].map(|mm| c_arm(30.0, [mm, 0.0, 0.0])).into();
        assert_eq!(stands(&table, [512; 2]), [0, 0, 2, 2, 0, 5]);
        let turning: Vec<CArm> = [30.0, 30.01, 32.0, 34.0, 34.0].map(|deg| c_arm(deg, [0.0; 3])).into();
        assert_eq!(stands(&turning, [512; 2]), [0, 0, 2, 3, 3]);
        assert_eq!(stands(&turning, [32; 2]), [0, 0, 2, 3, 3], "pixels are what they are, however many there are");
    }

    #[test]
    fn what_cannot_have_been_is_a_view_of_its_own() {
        let mut c_arms = vec![c_arm(30.0, [0.0; 3]); 3];
        c_arms[1].primary_deg = 1e9;
        assert_eq!(stands(&c_arms, [64; 2]), [0, 1, 0]);
    }
}
