//! The view to take next: for every position of a C-arm, how much of the vessels other vessels would cover, and how much the projection
//! would shorten them.

use crate::error::{Error, Result};
use crate::geometry::{CArm, Geometry, ViewRays, rotation, world_from_lps_mm};
use crate::scan::gating::SYSTOLE_SHARE;
use crate::trees::information::Information;
use crate::trees::refine::tangents;
use crate::trees::sight::{Sight, TreeInView};
use crate::trees::tree::{Branch, PhaseTree, TreeView};
use glam::DVec3;
use rayon::prelude::*;
use serde::Serialize;

/// Angle to the nearest training view from which on a view adds all that it can, degrees.
const NEW_DEG: f64 = 30.0;
/// Weight of foreshortening beside overlap, for a whole tree: a third view of two costs little by it.
const SHORTENED: f64 = 0.25;

/// Limits of a C-arm, degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmLimits {
    /// Lowest and highest primary angle; LAO is positive.
    pub primary_deg: [f64; 2],
    /// Lowest and highest secondary angle; cranial is positive.
    pub secondary_deg: [f64; 2],
    /// Step between positions.
    pub step_deg: f64,
}

impl Default for ArmLimits {
    /// Returns the positions that most C-arms reach.
    fn default() -> Self {
        ArmLimits { primary_deg: [-90.0, 90.0], secondary_deg: [-40.0, 40.0], step_deg: 5.0 }
    }
}

/// Returns the phases that a view is judged by: the ends of diastole and systole, between which vessels move most.
pub fn decisive_phases(n_phases: u32) -> Vec<u32> {
    let systole = (SYSTOLE_SHARE * f64::from(n_phases)).round() as u32 % n_phases.max(1);
    if systole == 0 { vec![0] } else { vec![0, systole] }
}

/// A further view, and how it would show the vessels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Candidate {
    /// Primary angle, degrees; LAO is positive.
    pub primary_deg: f64,
    /// Secondary angle, degrees; cranial is positive.
    pub secondary_deg: f64,
    /// Share of the length over which the image of another vessel touches a vessel, 0 to 1.
    pub overlap: f64,
    /// Overlap among the parts that few of several fits have, each weighted by the share of the fits that lack it; none for a
    /// single fit, and where all fits agree.
    pub doubtful_overlap: Option<f64>,
    /// Share of the length that the projection loses, 0 to 1.
    pub foreshortening: f64,
    /// Share of the length that lies outside the image, 0 to 1.
    pub outside: f64,
    /// Share of the doubt about places across vessels that the view would remove: the mean over the length of how far the largest
    /// error at a place would fall, 0 to 1. None where no training view is known.
    pub doubt_removed: Option<f64>,
    /// Angle to the nearest training view, or to the view opposite to it, degrees; none where no training view is known.
    pub nearest_view_deg: Option<f64>,
    /// Measure of what the view lacks: the lowest is the best.
    pub cost: f64,
}

/// Vessels for which a view is sought.
pub struct Subject<'a> {
    /// The tree at phases that count alike.
    pub phases: &'a [PhaseTree],
    /// Resolution of the field that the tree was found in, mm.
    pub resolution_mm: f64,
    /// Training views.
    pub views: &'a [TreeView],
    /// The only branch that counts; all of them by default.
    pub branch: Option<usize>,
    /// C-arm of the further view: its angles are replaced.
    pub c_arm: &'a CArm,
    /// Columns and rows of the image.
    pub image_size: [usize; 2],
}

/// Returns the positions of a C-arm within limits: primary angles in rows of one secondary angle each, both ascending.
///
/// # Errors
/// [`Error::Config`] for limits and steps that are not angles, and for a branch that the tree does not have.
pub fn candidates(subject: &Subject<'_>, limits: &ArmLimits) -> Result<Vec<Candidate>> {
    let primary = angles("primary", limits.primary_deg, limits.step_deg)?;
    let secondary = angles("secondary", limits.secondary_deg, limits.step_deg)?;
    if let (Some(branch), Some(tree)) = (subject.branch, subject.phases.first())
        && branch >= tree.branches.len()
    {
        let problem = format!("is not in the tree, which has branches 0 to {}", tree.branches.len().saturating_sub(1));
        return Err(Error::config("branch", branch, problem));
    }
    let known: Vec<Known> = subject.phases.iter().map(|tree| Known::of(tree, subject)).collect();
    let positions: Vec<(f64, f64)> = secondary.iter().flat_map(|s| primary.iter().map(|p| (*p, *s))).collect();
    positions.par_iter().map(|(primary, secondary)| subject.candidate(&known, *primary, *secondary)).collect()
}

/// Information of the training views about the points of a tree.
struct Known {
    /// Information about each point, `[branch][point]`.
    information: Vec<Vec<Information>>,
    /// Error at each point along its least certain direction, in units of the error of one image.
    errors: Vec<Vec<f64>>,
}

impl Known {
    fn of(tree: &PhaseTree, subject: &Subject<'_>) -> Known {
        let shown: Vec<TreeInView> =
            subject.views.iter().map(|view| TreeInView::new(tree, &view.rays, subject.resolution_mm)).collect();
        let of_point = |branch: usize, point: usize, tangent: DVec3| {
            shown.iter().fold(Information::none(tangent), |sum, view| sum.with(view.ray(branch, point)))
        };
        let of_branch = |(index, branch): (usize, &Branch)| -> Vec<Information> {
            let tangents = tangents(&branch.points_mm).into_iter().enumerate();
            tangents.map(|(point, tangent)| of_point(index, point, tangent)).collect()
        };
        let information: Vec<Vec<Information>> = tree.branches.iter().enumerate().map(of_branch).collect();
        let error = |of: &Information| of.least_certain().1;
        Known { errors: information.iter().map(|branch| branch.iter().map(error).collect()).collect(), information }
    }

    /// Returns the share of the error at a point that a further ray removes.
    fn removed(&self, branch: usize, point: usize, ray: DVec3) -> f64 {
        1.0 - self.information[branch][point].with(ray).least_certain().1 / self.errors[branch][point]
    }
}

/// Returns the best candidates, at most `count`, at least `apart_deg` from one another.
pub fn best(candidates: &[Candidate], count: usize, apart_deg: f64) -> Vec<Candidate> {
    let mut in_order: Vec<&Candidate> = candidates.iter().collect();
    in_order.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    let mut chosen: Vec<Candidate> = Vec::new();
    for candidate in in_order {
        let axis = axis(candidate.primary_deg, candidate.secondary_deg);
        let is_new =
            |other: &Candidate| angle_deg(axis, self::axis(other.primary_deg, other.secondary_deg)) >= apart_deg;
        if chosen.len() < count && chosen.iter().all(is_new) {
            chosen.push(*candidate);
        }
    }
    chosen
}

/// Returns angles at steps within limits, degrees.
fn angles(name: &str, [low, high]: [f64; 2], step: f64) -> Result<Vec<f64>> {
    let is_range = low.is_finite() && high.is_finite() && -180.0 <= low && low <= high && high <= 180.0;
    if !is_range {
        return Err(Error::config(
            name,
            format!("{low} to {high}"),
            "is not a range of angles from -180 to 180 degrees",
        ));
    }
    if !(step.is_finite() && (1.0..=90.0).contains(&step)) {
        return Err(Error::config("step", step, "is not a step from 1 to 90 degrees"));
    }
    Ok((0..=((high - low) / step).floor() as u32).map(|i| low + f64::from(i) * step).collect())
}

/// Returns the unit axis from the source to the detector of a C-arm, world axes.
fn axis(primary_deg: f64, secondary_deg: f64) -> DVec3 {
    rotation(primary_deg, secondary_deg) * DVec3::Z
}

/// Returns the angle between two lines, degrees: opposite views show the same.
fn angle_deg(a: DVec3, b: DVec3) -> f64 {
    a.dot(b).abs().clamp(0.0, 1.0).acos().to_degrees()
}

/// Sums over the vessels in an image, mm.
#[derive(Default)]
struct Sums {
    length: f64,
    covered: f64,
    lost: f64,
    outside: f64,
    doubtful: f64,
    doubtful_covered: f64,
    removed: f64,
}

impl Subject<'_> {
    fn candidate(&self, known: &[Known], primary_deg: f64, secondary_deg: f64) -> Result<Candidate> {
        let c_arm = CArm { primary_deg, secondary_deg, ..self.c_arm.clone() };
        let [width, height] = self.image_size;
        let rays = Geometry::CArm(c_arm).rays(width, height).map_err(|(field, problem)| {
            Error::config("c_arm", field, format!("{problem}: no further view can be planned with it"))
        })?;
        let mut sums = Sums::default();
        self.phases.iter().zip(known).for_each(|(tree, known)| self.add(tree, known, &rays, &mut sums));
        let axis = axis(primary_deg, secondary_deg);
        let to_view = |view: &TreeView| angle_deg(axis, view.rays.axis().normalize_or(DVec3::X));
        let nearest_view_deg = self.views.iter().map(to_view).min_by(f64::total_cmp);
        let share = |part: f64| if sums.length > 0.0 { part / sums.length } else { 0.0 };
        let doubtful_overlap = (sums.doubtful > 0.0).then(|| sums.doubtful_covered / sums.doubtful);
        let (overlap, foreshortening, outside) = (share(sums.covered), share(sums.lost), share(sums.outside));
        let is_near = nearest_view_deg.map_or(0.0, |deg| (1.0 - deg / NEW_DEG).max(0.0));
        let cost = match self.branch {
            // A branch is looked at: it is to be seen whole, from wherever that may be.
            Some(_) => overlap + foreshortening + outside,
            None => overlap + doubtful_overlap.unwrap_or(overlap) + SHORTENED * foreshortening + outside + is_near,
        };
        Ok(Candidate {
            primary_deg,
            secondary_deg,
            overlap,
            doubtful_overlap,
            foreshortening,
            outside,
            doubt_removed: (!self.views.is_empty()).then(|| share(sums.removed)),
            nearest_view_deg,
            cost,
        })
    }

    fn add(&self, tree: &PhaseTree, known: &Known, rays: &ViewRays, sums: &mut Sums) {
        let shown = TreeInView::new(tree, rays, self.resolution_mm);
        let [width, height] = self.image_size.map(|n| n as f64 - 0.5);
        let counts = |index: usize| self.branch.is_none_or(|branch| branch == index);
        for (index, branch) in tree.branches.iter().enumerate().filter(|(index, _)| counts(*index)) {
            for point in 1..branch.points_mm.len() {
                let step_mm = branch.points_mm[point].distance(branch.points_mm[point - 1]);
                let places = [(index, point - 1), (index, point)];
                let Some(Sight { foreshortening, overlap }) = shown.sight(tree, &places) else { continue };
                let inside = rays
                    .project(world_from_lps_mm(branch.points_mm[point]))
                    .is_some_and(|(column, row)| (-0.5..width).contains(&column) && (-0.5..height).contains(&row));
                let doubt = step_mm * (1.0 - branch.agreement.get(point).copied().unwrap_or(1.0));
                sums.length += step_mm;
                sums.covered += overlap * step_mm;
                sums.lost += foreshortening * step_mm;
                sums.outside += if inside { 0.0 } else { step_mm };
                // A place that another vessel covers, or that lies outside, is not measured.
                let is_measured = inside && !shown.is_covered(index, point);
                let removed = if is_measured { known.removed(index, point, shown.ray(index, point)) } else { 0.0 };
                sums.removed += removed * step_mm;
                sums.doubtful += doubt;
                sums.doubtful_covered += overlap * doubt;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    const LIMITS: ArmLimits = ArmLimits { primary_deg: [-90.0, 90.0], secondary_deg: [-40.0, 40.0], step_deg: 10.0 };

    fn c_arm() -> CArm {
        CArm {
            primary_deg: 0.0,
            secondary_deg: 0.0,
            sid_mm: 1000.0,
            sod_mm: 700.0,
            pixel_mm: [1.0; 2],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        }
    }

    fn line(from: [f64; 3], to: [f64; 3], agreement: f64) -> Branch {
        let (from, to) = (DVec3::from_array(from), DVec3::from_array(to));
        Branch {
            parent: None,
            points_mm: (0..21).map(|i| from.lerp(to, f64::from(i) / 20.0)).collect(),
            radius_mm: vec![1.5; 21],
            agreement: vec![agreement; 21],
            doubt: Vec::new(),
            gap_mm: 0.0,
        }
    }

    fn view(primary_deg: f64) -> TreeView {
        let c_arm = CArm { primary_deg, ..c_arm() };
        let rays = Geometry::CArm(c_arm).rays(100, 100).unwrap();
        TreeView { view: 0, angles_deg: Some((primary_deg, 0.0)), rays }
    }

    fn found(tree: &PhaseTree, views: &[TreeView], branch: Option<usize>) -> Vec<Candidate> {
        let c_arm = c_arm();
        let phases = std::slice::from_ref(tree);
        let subject = Subject { phases, resolution_mm: 1.0, views, branch, c_arm: &c_arm, image_size: [100; 2] };
        candidates(&subject, &LIMITS).unwrap()
    }

    #[test]
    fn a_view_across_the_known_ones_removes_the_doubt_about_depth() {
        let tree = PhaseTree { phase: 0, branches: vec![line([0.0, 0.0, -15.0], [0.0, 0.0, 15.0], 1.0)] };
        let views = [view(-10.0), view(10.0)];
        let all = found(&tree, &views, None);
        let removed = |primary: f64| {
            all.iter().find(|c| (c.primary_deg, c.secondary_deg) == (primary, 0.0)).unwrap().doubt_removed.unwrap()
        };
        // The views are 20 degrees apart: the error of the depth is 1 / sqrt(2 sin(10)^2) = 4.07 times that of a place in an image. A view
        // from the side adds 1 to the information about the depth, whose error stays larger than that across, 1 / sqrt(2 cos(10)^2).
        let expected = 1.0 - 1.0 / (1.0 + 2.0 * 10f64.to_radians().sin().powi(2)).sqrt() / 4.072;
        assert!((removed(90.0) - expected).abs() < 0.02, "{} instead of {expected}", removed(90.0));
        assert!(removed(0.0) < 0.02, "between the views it tells nothing new: {}", removed(0.0));
        assert!(found(&tree, &[], None)[0].doubt_removed.is_none());
    }

    #[test]
    fn a_branch_is_best_seen_across_and_where_nothing_covers_it() {
        // Along left, so that frontal views show it whole; a second one runs in front of it.
        let tree = PhaseTree {
            phase: 0,
            branches: vec![
                line([-15.0, 0.0, 0.0], [15.0, 0.0, 0.0], 1.0),
                line([-15.0, -20.0, 0.0], [15.0, -20.0, 0.0], 1.0),
            ],
        };
        let all = found(&tree, &[], Some(0));
        assert_eq!(all.len(), 19 * 9);
        let at = |primary: f64, secondary: f64| {
            *all.iter().find(|c| (c.primary_deg, c.secondary_deg) == (primary, secondary)).unwrap()
        };
        assert!(at(0.0, 0.0).overlap > 0.9, "{:?}", at(0.0, 0.0));
        assert!(at(90.0, 0.0).foreshortening > 0.9, "{:?}", at(90.0, 0.0));
        let best = best(&all, 2, 20.0);
        assert!(
            best[0].overlap == 0.0 && best[0].primary_deg == 0.0 && best[0].secondary_deg.abs() >= 20.0,
            "{best:?}"
        );
        assert!(
            angle_deg(
                axis(best[0].primary_deg, best[0].secondary_deg),
                axis(best[1].primary_deg, best[1].secondary_deg)
            ) >= 20.0
        );
    }

    #[test]
    fn parts_that_fits_disagree_about_are_to_be_seen_alone() {
        // The doubtful one lies behind the first in the frontal view, and alone in the lateral one.
        let tree = PhaseTree {
            phase: 0,
            branches: vec![
                line([0.0, 0.0, -15.0], [0.0, 0.0, 15.0], 1.0),
                line([0.0, 20.0, -15.0], [0.0, 20.0, 15.0], 0.4),
            ],
        };
        let all = found(&tree, &[view(45.0)], None);
        let best = best(&all, 1, 0.0)[0];
        assert_eq!(best.doubtful_overlap, Some(0.0));
        assert!(best.nearest_view_deg.unwrap() >= NEW_DEG && best.outside == 0.0, "{best:?}");
        let frontal = all.iter().find(|c| c.primary_deg == 0.0 && c.secondary_deg == 0.0).unwrap();
        assert!(frontal.doubtful_overlap.unwrap() > 0.9 && frontal.cost > best.cost + 1.0, "{frontal:?}");
        assert!((frontal.nearest_view_deg.unwrap() - 45.0).abs() < 1e-6, "{frontal:?}");
    }

    #[test]
    fn impossible_limits_and_branches_are_refused() {
        let tree = PhaseTree { phase: 0, branches: vec![line([0.0; 3], [5.0; 3], 1.0)] };
        let c_arm = c_arm();
        let subject = |branch| Subject {
            phases: std::slice::from_ref(&tree),
            resolution_mm: 1.0,
            views: &[],
            branch,
            c_arm: &c_arm,
            image_size: [100; 2],
        };
        let refused = |branch, limits: ArmLimits| candidates(&subject(branch), &limits).unwrap_err().to_string();
        assert!(refused(Some(3), LIMITS).contains("branches 0 to 0"));
        assert!(refused(None, ArmLimits { primary_deg: [20.0, -20.0], ..LIMITS }).contains("primary"));
        assert!(refused(None, ArmLimits { secondary_deg: [f64::NAN, 0.0], ..LIMITS }).contains("secondary"));
        assert!(refused(None, ArmLimits { step_deg: 0.0, ..LIMITS }).contains("step"));
    }
}
