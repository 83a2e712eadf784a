//! Groups the frames of a run by C-arm pose: a moving C-arm or table gives a run several views.

use crate::geometry::{CArm, Geometry, ViewRays};
use crate::scan::same_view::agree;

/// Returns, for each frame, the index of the first frame with the same pose; images have `size` (columns, rows).
pub(super) fn stands(c_arms: &[CArm], size: [usize; 2]) -> Vec<usize> {
    let rays: Vec<Option<ViewRays>> =
        c_arms.iter().map(|c_arm| Geometry::CArm(c_arm.clone()).rays(size[0], size[1]).ok()).collect();
    let same = |a: usize, b: usize| match (&rays[a], &rays[b]) {
        _ if c_arms[a] == c_arms[b] => true,
        (Some(a), Some(b)) => agree(a, b),
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
        // A pixel is 0.3 mm at the isocentre. A tenth of it is 0.03 mm of the table, or an angle of 0.03 degrees at 50 mm.
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
