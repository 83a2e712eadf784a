//! The rule by which frames share a view, for all ways in: images of one size whose geometries agree within a tenth of a pixel. A
//! C-arm reports its angles for each frame, with the noise of its sensors.

use crate::geometry::{Geometry, ViewRays, world_from_lps_mm};
use crate::scan::dataset::View;
use crate::scan::frame_checks::{Complaint, checked_view};
use glam::DVec3;

/// Distance below which two geometries are those of one view, pixels: the largest between their projections of points of the
/// heart.
pub const SAME_VIEW_PX: f64 = 0.1;
/// Half side of a cube around the isocentre that represents the heart, mm.
const HEART_MM: f64 = 50.0;

/// Tells whether two geometries of images of one size are those of one view.
pub fn agree(a: &ViewRays, b: &ViewRays) -> bool {
    let sign = |k: usize, axis: usize| if k >> axis & 1 == 1 { HEART_MM } else { -HEART_MM };
    let mut corners = (0..8).map(|k| world_from_lps_mm(DVec3::new(sign(k, 0), sign(k, 1), sign(k, 2))));
    a == b
        || corners.all(|point| {
            a.project(point).zip(b.project(point)).is_some_and(|((x, y), (u, v))| (x - u).hypot(y - v) < SAME_VIEW_PX)
        })
}

/// Returns the index of the view of images of `size` (columns, rows): the first one that agrees with `geometry`, or a new one at
/// the end of the list. The source must lie outside the searched depth range, which begins `depth_before` world units before the
/// isocentre.
pub fn find_or_add(
    views: &mut Vec<View>,
    geometry: Geometry,
    size: [usize; 2],
    depth_before: f64,
) -> Result<usize, Complaint> {
    let new = checked_view(geometry, size, depth_before)?;
    if let Some(known) = views.iter().position(|view| view.size == size && agree(&view.rays, &new.rays)) {
        return Ok(known);
    }
    views.push(new);
    Ok(views.len() - 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CArm;
    use crate::geometry::tests::matrix_of;

    fn c_arm(primary_deg: f64, left_mm: f64) -> CArm {
        CArm {
            primary_deg,
            secondary_deg: 10.0,
            sid_mm: 1000.0,
            sod_mm: 750.0,
            pixel_mm: [0.4; 2],
            offset_mm: [0.0; 2],
            table_mm: [left_mm, 0.0, 0.0],
        }
    }

    /// Indices of the views of frames of 64 x 48 pixels.
    fn views_of(geometries: impl IntoIterator<Item = Geometry>) -> Vec<usize> {
        let mut views = Vec::new();
        let mut view = |geometry| find_or_add(&mut views, geometry, [64, 48], 1.0).ok().unwrap();
        geometries.into_iter().map(&mut view).collect()
    }

    #[test]
    fn geometries_within_a_tenth_of_a_pixel_are_one_view() {
        // A pixel is 0.3 mm at the isocentre. A tenth of it is 0.03 mm of the table, or an angle of 0.03 degrees at 50 mm.
        let table = [0.0, 0.015, 2.0, 2.01, 0.01, 4.0].map(|mm| Geometry::CArm(c_arm(30.0, mm)));
        assert_eq!(views_of(table), [0, 0, 1, 1, 0, 2]);
        let turning = [30.0, 30.01, 30.0 + 1e-9, 32.0, 34.0, 34.0].map(|deg| Geometry::CArm(c_arm(deg, 0.0)));
        assert_eq!(views_of(turning), [0, 0, 0, 1, 2, 2]);
        // Angles differ by whole turns, or are stated by a matrix.
        let rays = Geometry::CArm(c_arm(30.0, 0.0)).rays(64, 48).unwrap();
        let stated = [Geometry::CArm(c_arm(30.0, 0.0)), Geometry::CArm(c_arm(-330.0, 0.0)), matrix_of(&rays)];
        assert_eq!(views_of(stated), [0, 0, 0]);
    }

    #[test]
    fn slow_motion_does_not_add_up_within_a_view() {
        // Each step is 0.04 pixels; each view has the frames within a tenth of a pixel of its first one.
        let slow = (0..6).map(|k| Geometry::CArm(c_arm(30.0, 0.012 * f64::from(k))));
        assert_eq!(views_of(slow), [0, 0, 0, 1, 1, 1]);
    }

    #[test]
    fn images_of_different_sizes_are_different_views() {
        let mut views = Vec::new();
        let mut view = |size| find_or_add(&mut views, Geometry::CArm(c_arm(30.0, 0.0)), size, 1.0).ok().unwrap();
        assert_eq!([view([64, 48]), view([48, 64]), view([64, 48])], [0, 1, 0]);
    }
}
