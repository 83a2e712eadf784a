//! Sight of vessels in a view: how much a projection shortens them, and where others lie over them.

use crate::geometry::{MM_PER_UNIT, ViewRays, world_from_lps_mm};
use crate::trees::tree::PhaseTree;
use glam::{DVec2, DVec3};

/// Distance in space within which vessels touch, in units of the field's resolution beyond their radii: near a bifurcation all views
/// show them together.
const TOUCHING: f64 = 2.0;

/// Sight of a part of a tree in a view.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sight {
    /// Share of the length that the projection loses, 0 to 1.
    pub foreshortening: f64,
    /// Share of the length over which the image of another vessel touches that of the part, 0 to 1.
    pub overlap: f64,
}

/// A point of a centreline as a view shows it.
#[derive(Debug, Clone, Copy)]
struct Seen {
    branch: usize,
    point: usize,
    place_mm: DVec3,
    radius_mm: f64,
    pixel: DVec2,
    radius_px: f64,
    /// Unit direction of the ray.
    along: DVec3,
}

/// Tree as a view shows it.
pub struct TreeInView {
    /// Whether another vessel lies over a point, `[branch][point]`.
    covered: Vec<Vec<bool>>,
    /// Unit directions of the rays through the points, LPS, `[branch][point]`.
    rays: Vec<Vec<DVec3>>,
}

impl TreeInView {
    /// Projects a tree that was extracted from a field of a resolution, mm.
    pub fn new(tree: &PhaseTree, view: &ViewRays, resolution_mm: f64) -> TreeInView {
        let lengths = || tree.branches.iter().map(|branch| branch.points_mm.len());
        let mut shown = TreeInView {
            covered: lengths().map(|n| vec![false; n]).collect(),
            rays: lengths().map(|n| vec![DVec3::Z; n]).collect(),
        };
        let mut seen = seen_points(tree, view);
        seen.iter().for_each(|s| shown.rays[s.branch][s.point] = s.along);
        // Neighbours along the columns are neighbours in the list.
        seen.sort_by(|a, b| a.pixel.x.total_cmp(&b.pixel.x));
        let widest_px = seen.iter().map(|s| s.radius_px).fold(0.0, f64::max);
        for (i, one) in seen.iter().enumerate() {
            let near = seen[i + 1..].iter().take_while(|other| other.pixel.x - one.pixel.x < one.radius_px + widest_px);
            for other in near.filter(|other| lie_over(one, other, resolution_mm)) {
                shown.covered[one.branch][one.point] = true;
                shown.covered[other.branch][other.point] = true;
            }
        }
        shown
    }

    /// Returns the sight of points of the tree (branch and point of each) that follow one another along a vessel; `None` where they have
    /// no length.
    pub fn sight(&self, tree: &PhaseTree, places: &[(usize, usize)]) -> Option<Sight> {
        let (mut length, mut shown, mut covered) = (0.0, 0.0, 0.0);
        for pair in places.windows(2) {
            let [from, to] = [pair[0], pair[1]].map(|(branch, point)| tree.branches[branch].points_mm[point]);
            let step = to - from;
            let (branch, point) = pair[1];
            length += step.length();
            shown += step.reject_from_normalized(self.rays[branch][point]).length();
            covered += if self.covered[branch][point] { step.length() } else { 0.0 };
        }
        (length > 0.0).then(|| Sight { foreshortening: 1.0 - shown / length, overlap: covered / length })
    }

    /// Tells whether another vessel lies over a point.
    pub fn is_covered(&self, branch: usize, point: usize) -> bool {
        self.covered[branch][point]
    }

    /// Returns the unit direction of the ray through a point, LPS.
    pub fn ray(&self, branch: usize, point: usize) -> DVec3 {
        self.rays[branch][point]
    }
}

/// Projects the points of a tree that lie before the source.
fn seen_points(tree: &PhaseTree, view: &ViewRays) -> Vec<Seen> {
    let pixel_share = view.direction[1].length();
    let (source, axis) = (view.source(), view.axis());
    let mut seen = Vec::new();
    for (branch, line) in tree.branches.iter().enumerate() {
        for (point, (place_mm, radius_mm)) in line.points_mm.iter().zip(&line.radius_mm).enumerate() {
            let place = world_from_lps_mm(*place_mm);
            let Some((column, row)) = view.project(place) else { continue };
            let away = place - source;
            // World axes are (posterior, left, superior).
            let along = DVec3::new(away.y, away.x, away.z).normalize_or(DVec3::Z);
            let pixel_mm = pixel_share * away.dot(axis).abs() * MM_PER_UNIT;
            seen.push(Seen {
                branch,
                point,
                place_mm: *place_mm,
                radius_mm: *radius_mm,
                pixel: DVec2::new(column, row),
                radius_px: radius_mm / pixel_mm,
                along,
            });
        }
    }
    seen
}

/// Tells whether the images of two points of vessels that do not touch in space lie over each other.
fn lie_over(a: &Seen, b: &Seen, resolution_mm: f64) -> bool {
    let touch_mm = a.radius_mm + b.radius_mm + TOUCHING * resolution_mm;
    a.pixel.distance(b.pixel) < a.radius_px + b.radius_px && a.place_mm.distance(b.place_mm) > touch_mm
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CArm, Geometry};
    use crate::trees::tree::Branch;

    const RESOLUTION_MM: f64 = 1.0;

    fn view(primary_deg: f64, secondary_deg: f64) -> ViewRays {
        let c_arm = CArm {
            primary_deg,
            secondary_deg,
            sid_mm: 1e5,
            sod_mm: 9e4,
            pixel_mm: [0.5; 2],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        };
        Geometry::CArm(c_arm).rays(200, 200).unwrap()
    }

    fn line(from: DVec3, to: DVec3) -> Branch {
        Branch {
            parent: None,
            points_mm: (0..41).map(|i| from.lerp(to, f64::from(i) / 40.0)).collect(),
            radius_mm: vec![1.0; 41],
            agreement: Vec::new(),
            doubt: Vec::new(),
            gap_mm: 0.0,
        }
    }

    fn all(branch: usize) -> Vec<(usize, usize)> {
        (0..41).map(|point| (branch, point)).collect()
    }

    fn tree(branches: Vec<Branch>) -> PhaseTree {
        PhaseTree { phase: 0, branches }
    }

    #[test]
    fn a_vessel_is_shortened_by_the_cosine_of_its_slope() {
        // The frontal view looks from the front to the back: it shows left and superior.
        let slope = 30f64.to_radians();
        let tree = tree(vec![line(DVec3::ZERO, 20.0 * DVec3::new(slope.cos(), slope.sin(), 0.0))]);
        let seen = |view: &ViewRays| TreeInView::new(&tree, view, RESOLUTION_MM).sight(&tree, &all(0)).unwrap();
        assert!((seen(&view(0.0, 0.0)).foreshortening - (1.0 - slope.cos())).abs() < 1e-3);
        // A C-arm that is turned by 90 degrees looks along left.
        assert!((seen(&view(90.0, 0.0)).foreshortening - (1.0 - slope.sin())).abs() < 1e-3);
        assert_eq!(seen(&view(0.0, 0.0)).overlap, 0.0);
    }

    #[test]
    fn vessels_behind_one_another_overlap_and_those_that_touch_do_not() {
        let across = line(DVec3::new(-10.0, 0.0, 0.0), DVec3::new(10.0, 0.0, 0.0));
        // 20 mm behind the first, and across it.
        let behind = line(DVec3::new(0.0, 20.0, -10.0), DVec3::new(0.0, 20.0, 10.0));
        let crossing = tree(vec![across.clone(), behind]);
        let frontal = TreeInView::new(&crossing, &view(0.0, 0.0), RESOLUTION_MM);
        // Both lumens are 2 mm wide: they touch over 4 of 20 mm.
        let sight = frontal.sight(&crossing, &all(0)).unwrap();
        assert!((sight.overlap - 0.2).abs() < 0.06, "{sight:?}");
        assert!(frontal.is_covered(0, 20) && !frontal.is_covered(0, 0) && frontal.is_covered(1, 20));
        let lateral = TreeInView::new(&crossing, &view(90.0, 0.0), RESOLUTION_MM);
        assert_eq!(lateral.sight(&crossing, &all(1)).unwrap().overlap, 0.0);
        let fork = tree(vec![across, line(DVec3::ZERO, DVec3::new(0.0, 3.0, 0.0))]);
        assert_eq!(TreeInView::new(&fork, &view(0.0, 0.0), RESOLUTION_MM).sight(&fork, &all(0)).unwrap().overlap, 0.0);
    }

    #[test]
    fn parts_without_length_have_no_sight() {
        let tree = tree(vec![line(DVec3::ZERO, DVec3::X)]);
        let view = TreeInView::new(&tree, &view(0.0, 0.0), RESOLUTION_MM);
        assert_eq!((view.sight(&tree, &[]), view.sight(&tree, &[(0, 3)])), (None, None));
    }
}
