//! Agreement of two sets of voxels, in millimetres (see `docs/formats.md`).

use crate::error::{Error, Result};
use crate::raster::percentile;
use crate::score::metrics;
use crate::vessels::centreline::centreline;
use crate::vessels::distances::DistanceMap;
use crate::vessels::mask::{Mask, component_sizes};
use rayon::prelude::*;
use serde::Serialize;

/// Maximum distance at which centrelines count as one vessel, mm.
pub const WITHIN_MM: f64 = 1.0;
/// Percentile of the distances that gives the Hausdorff distance.
const HAUSDORFF_SHARE: f64 = 0.95;

/// Agreement of a reconstructed set of voxels with the true one. Distances are between centres of voxels; `None` where a
/// set is empty.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Agreement {
    /// Dice overlap, 0 to 1.
    pub dice: f64,
    /// Mean distance of a voxel of one set to the nearest of the other, both directions with equal weight, mm.
    pub chamfer_mm: Option<f64>,
    /// The larger of both directions' 95th percentiles of these distances, mm.
    pub hausdorff95_mm: Option<f64>,
    /// Share of the true centreline's voxels with a reconstructed one within [`WITHIN_MM`].
    pub true_centreline_found: Option<f64>,
    /// Share of the reconstructed centreline's voxels with a true one within [`WITHIN_MM`].
    pub our_centreline_true: Option<f64>,
    /// Centreline Dice: the harmonic mean of the shares of each centreline inside the other set.
    pub cl_dice: Option<f64>,
    /// Connected components (26 neighbours) of the reconstruction that are large enough to count.
    pub components: f64,
    /// Connected components of the truth, mean over the phases.
    pub true_components: f64,
}

/// A non-empty set, the distances to it, and its centreline.
struct Measured<'a> {
    set: &'a Mask,
    to_set: DistanceMap,
    line: Mask,
}

impl Measured<'_> {
    fn new(set: &Mask) -> Option<Measured<'_>> {
        let (to_set, line) = rayon::join(|| DistanceMap::to(set), || centreline(set));
        Some(Measured { set, to_set: to_set?, line })
    }
}

/// Distances of the voxels of a set from another, mm.
fn distances(set: &Mask, to: &DistanceMap) -> Vec<f32> {
    set.voxels().map(|voxel| to.at_mm(voxel)).collect()
}

fn mean_distance(set: &Mask, to: &DistanceMap) -> f64 {
    let distances = distances(set, to);
    distances.iter().map(|d| f64::from(*d)).sum::<f64>() / distances.len() as f64
}

/// Mean distance of a voxel of one set to the nearest of the other, both directions with equal weight, mm.
fn mean_of_both([a, b]: [&Mask; 2], [to_a, to_b]: [&DistanceMap; 2]) -> f64 {
    0.5 * (mean_distance(a, to_b) + mean_distance(b, to_a))
}

/// Chamfer distance of two sets of voxels of one grid, as in [`Agreement`].
pub(super) fn chamfer_mm(a: &Mask, b: &Mask) -> Option<f64> {
    let (to_a, to_b) = rayon::join(|| DistanceMap::to(a), || DistanceMap::to(b));
    Some(mean_of_both([a, b], [&to_a?, &to_b?]))
}

fn far_distance(set: &Mask, to: &DistanceMap) -> f64 {
    f64::from(percentile(&distances(set, to), HAUSDORFF_SHARE))
}

/// Share of a line's voxels with one of another line within [`WITHIN_MM`].
fn share_near(line: &Mask, other: &Mask) -> f64 {
    let reach = (WITHIN_MM / line.spacing_mm).floor().as_usizevec3().to_array();
    let [nx, ny, _] = line.size;
    let has_near = |voxel: usize| {
        let at = [voxel % nx, voxel / nx % ny, voxel / (nx * ny)];
        let around =
            |axis: usize| at[axis].saturating_sub(reach[axis])..=(at[axis] + reach[axis]).min(line.size[axis] - 1);
        let away = |axis: usize, i: usize| (at[axis].abs_diff(i) as f64 * line.spacing_mm[axis]).powi(2);
        around(2).any(|z| {
            around(1).any(|y| {
                around(0).any(|x| {
                    other.inside[(z * ny + y) * nx + x] && away(0, x) + away(1, y) + away(2, z) <= WITHIN_MM.powi(2)
                })
            })
        })
    };
    share(line, has_near)
}

/// Share of a set's voxels for which `holds` is true.
fn share(set: &Mask, holds: impl Fn(usize) -> bool + Sync) -> f64 {
    let voxels: Vec<usize> = set.voxels().collect();
    voxels.par_iter().filter(|voxel| holds(**voxel)).count() as f64 / voxels.len() as f64
}

/// Harmonic mean of the shares of two centrelines that lie inside the other set.
fn cl_dice(a: &Measured<'_>, b: &Measured<'_>) -> f64 {
    match (share(&a.line, |voxel| b.set.inside[voxel]), share(&b.line, |voxel| a.set.inside[voxel])) {
        (0.0, 0.0) => 0.0,
        (a, b) => 2.0 * a * b / (a + b),
    }
}

/// Compares two sets of voxels of one grid. Components smaller than `smallest_component_mm3` are excluded from the numbers
/// of components only.
///
/// # Errors
/// [`Error::Config`] for sets on different grids.
pub fn compare(truth: &Mask, ours: &Mask, smallest_component_mm3: f64) -> Result<Agreement> {
    if (truth.size, truth.spacing_mm) != (ours.size, ours.spacing_mm) {
        let grids = format!("{:?} and {:?} voxels", truth.size, ours.size);
        return Err(Error::config("grid", grids, "two sets are compared on one grid"));
    }
    let (measured_truth, measured_ours) = rayon::join(|| Measured::new(truth), || Measured::new(ours));
    let both = measured_truth.zip(measured_ours);
    let of_both = |measure: fn(&Measured<'_>, &Measured<'_>) -> f64| both.as_ref().map(|(t, o)| measure(t, o));
    let components = |set: &Mask| {
        let sizes = component_sizes(set);
        sizes.iter().filter(|size| **size as f64 * set.voxel_mm3() >= smallest_component_mm3).count() as f64
    };
    Ok(Agreement {
        dice: metrics::dice(&truth.inside, &ours.inside),
        chamfer_mm: of_both(|t, o| mean_of_both([t.set, o.set], [&t.to_set, &o.to_set])),
        hausdorff95_mm: of_both(|t, o| far_distance(t.set, &o.to_set).max(far_distance(o.set, &t.to_set))),
        true_centreline_found: of_both(|t, o| share_near(&t.line, &o.line)),
        our_centreline_true: of_both(|t, o| share_near(&o.line, &t.line)),
        cl_dice: of_both(cl_dice),
        components: components(ours),
        true_components: components(truth),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vessels::mask::tests::drawn;
    use glam::DVec3;

    const SPACING_MM: DVec3 = DVec3::new(0.5, 0.25, 1.0);

    /// A rod along x, displaced by `shift_mm` from the centre.
    fn rod(shift_mm: DVec3) -> Mask {
        drawn([60, 60, 24], SPACING_MM, |p| {
            let p = p - DVec3::new(15.0, 7.5, 12.0) - shift_mm;
            p.x.abs() <= 10.0 && p.y.abs() <= 0.6 && p.z.abs() <= 1.1
        })
    }

    #[test]
    fn a_set_agrees_with_itself() {
        let expected = Agreement {
            dice: 1.0,
            chamfer_mm: Some(0.0),
            hausdorff95_mm: Some(0.0),
            true_centreline_found: Some(1.0),
            our_centreline_true: Some(1.0),
            cl_dice: Some(1.0),
            components: 1.0,
            true_components: 1.0,
        };
        assert_eq!(compare(&rod(DVec3::ZERO), &rod(DVec3::ZERO), 0.1).unwrap(), expected);
    }

    /// Rods that are further apart than they are thick: the distance of each voxel is that of its row.
    #[test]
    fn a_translation_has_known_distances() {
        let truth = rod(DVec3::ZERO);
        for (shift_mm, rows_mm) in [
            // Five rows, 0.25 mm apart.
            (DVec3::new(0.0, 2.5, 0.0), vec![1.5, 1.75, 2.0, 2.25, 2.5]),
            // Three rows, 1 mm apart.
            (DVec3::new(0.0, 0.0, 6.0), vec![4.0, 5.0, 6.0]),
        ] {
            let scores = compare(&truth, &rod(shift_mm), 0.1).unwrap();
            let chamfer = rows_mm.iter().sum::<f64>() / rows_mm.len() as f64;
            assert!((scores.chamfer_mm.unwrap() - chamfer).abs() < 1e-6, "{scores:?}");
            assert_eq!(scores.hausdorff95_mm, rows_mm.last().copied(), "{scores:?}");
            assert_eq!((scores.dice, scores.cl_dice), (0.0, Some(0.0)));
            assert_eq!((scores.true_centreline_found, scores.our_centreline_true), (Some(0.0), Some(0.0)));
        }
        // At a displacement of a quarter of a millimetre, one row of five is missed, and the centrelines are near each
        // other.
        let scores = compare(&truth, &rod(DVec3::new(0.0, 0.25, 0.0)), 0.1).unwrap();
        assert!((scores.dice - 0.8).abs() < 1e-12 && (scores.chamfer_mm.unwrap() - 0.05).abs() < 1e-6, "{scores:?}");
        assert_eq!((scores.cl_dice, scores.true_centreline_found), (Some(1.0), Some(1.0)));
    }

    /// Additional voxels of one set count in that set's direction alone.
    #[test]
    fn both_directions_count() {
        let truth = rod(DVec3::ZERO);
        let half = Mask {
            inside: truth.inside.iter().enumerate().map(|(i, inside)| *inside && i % truth.size[0] < 30).collect(),
            ..truth.clone()
        };
        for (truth, ours, found, right) in [(&truth, &half, 0.55, 1.0), (&half, &truth, 1.0, 0.55)] {
            let scores = compare(truth, ours, 0.1).unwrap();
            // Voxels of the 21 missing columns are 0.5 to 10.5 mm away; all others are present.
            let missing = (1..=21).map(|i| 0.5 * f64::from(i)).sum::<f64>() / 41.0;
            assert!((scores.chamfer_mm.unwrap() - 0.5 * missing).abs() < 1e-6, "{scores:?}");
            assert_eq!(scores.hausdorff95_mm, Some(9.5), "{scores:?}");
            assert!((scores.true_centreline_found.unwrap() - found).abs() < 0.1, "{scores:?}");
            assert!((scores.our_centreline_true.unwrap() - right).abs() < 0.1, "{scores:?}");
            assert!((scores.dice - 40.0 / 61.0).abs() < 1e-12, "{scores:?}");
        }
    }

    #[test]
    fn a_shell_is_as_far_from_its_ball_as_it_is_wide() {
        let from_middle = |p: DVec3| p.distance(DVec3::splat(10.0));
        let ball = drawn([41; 3], DVec3::splat(0.5), |p| from_middle(p) < 1.0);
        let shell = drawn([41; 3], DVec3::splat(0.5), |p| (8.0..8.6).contains(&from_middle(p)));
        let scores = compare(&ball, &shell, 0.1).unwrap();
        // From the ball's surface at 1 mm, or its centre, to the shell at 8 mm: 7 to 8 mm, give or take half a voxel.
        assert!((7.0..8.0).contains(&scores.chamfer_mm.unwrap()), "{scores:?}");
        assert_eq!((scores.components, scores.true_components), (1.0, 1.0));
    }

    #[test]
    fn specks_are_no_components_and_nothing_has_no_distance() {
        let truth = rod(DVec3::ZERO);
        let mut ours = truth.clone();
        ours.inside[0] = true;
        assert_eq!(compare(&truth, &ours, 0.13).unwrap().components, 1.0, "a voxel has 0.125 mm³");
        assert_eq!(compare(&truth, &ours, 0.12).unwrap().components, 2.0);
        ours.inside.fill(false);
        let scores = compare(&truth, &ours, 0.1).unwrap();
        assert_eq!((scores.dice, scores.chamfer_mm, scores.cl_dice, scores.components), (0.0, None, None, 0.0));
        ours.spacing_mm.x = 1.0;
        assert!(compare(&truth, &ours, 0.1).is_err());
    }
}
