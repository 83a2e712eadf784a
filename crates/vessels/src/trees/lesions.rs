//! Stenoses: places where a vessel is narrower than its course elsewhere lets expect.

use crate::linear::Pentadiagonal;
use crate::trees::areas::blur::without_blur;
use crate::trees::tree::{BeatTree, Measurement, PhaseTree, RadiiFrom};
use glam::DVec3;
use std::f64::consts::TAU;
use std::ops::RangeInclusive;

// Numbers of this file without another source: developed on five draws of stenoses in five trees; a sixth draw took no part
// (docs/performance.md, Stenoses; docs/tried.md).
/// Diameter stenosis from which a narrowing is a lesion, percent. Healthy vessels of real anatomy vary by up to 25 %.
pub const MIN_PERCENT: f64 = 30.0;
/// Narrowing at which a lesion begins and ends, as a share of the reference diameter.
const EDGE: f64 = 0.1;
/// Wavelength, mm, of a variation of the radius that the reference follows to a half. Lesions are shorter.
const REFERENCE_MM: f64 = 100.0;
/// Weight of radii above the reference; those below have the rest, so that narrowings hardly lower it.
const ABOVE: f64 = 0.75;
/// Rounds of the reference; its weights no longer change then.
const ROUNDS: usize = 20;
/// Part of a lesion that must lie inside the vessel: where the narrowing exceeds this share of its maximum.
const CORE: f64 = 0.5;
/// Length at both ends of a vessel in which no core of a lesion may lie, in units of the field's resolution: ends are rounded. At the start of a
/// vessel that leaves another one, the part inside the lumen of that one is added.
const END: f64 = 1.5;
/// Length on both sides in which a vessel must be as wide as the reference, in units of the field's resolution.
const BESIDE: f64 = 10.0;
/// Standard deviation of the field's blur along a vessel, in units of the field's resolution: the minimum of its Gaussians.
const BLUR: f64 = 0.4;
/// Number of points that tell the width and direction of a branch at its start.
const START_POINTS: usize = 6;
/// Minimum length of a lesion, in units of the field's resolution: shorter narrowings are noise.
const MIN_LENGTH: f64 = 1.4;
/// Minimum reference diameter, in units of the field's resolution, where radii are those of the field and where they are those of the images:
/// whether a thinner vessel is narrowed cannot be told.
const MIN_REFERENCE: f64 = 1.0;
const MIN_REFERENCE_IN_IMAGES: f64 = 0.6;

/// A place where a vessel is narrowed.
#[derive(Debug, Clone, PartialEq)]
pub struct Lesion {
    /// Branch that contains the least diameter, as its index in the tree.
    pub branch: usize,
    /// Point of the branch with the least diameter, as its index.
    pub point: usize,
    /// Position of the least diameter along the vessels, mm from the root of the tree.
    pub from_root_mm: f64,
    /// Length of the part that is narrowed by a tenth of the reference or more, mm.
    pub length_mm: f64,
    /// Least diameter, mm, without the field's blur along the vessel.
    pub min_diameter_mm: f64,
    /// Reference diameter there, mm.
    pub reference_diameter_mm: f64,
    /// Points of the narrowed part, as branch and point.
    pub places: Vec<(usize, usize)>,
}

impl Lesion {
    /// Returns the diameter stenosis: the narrowing in percent of the reference diameter.
    pub fn percent(&self) -> f64 {
        100.0 * (1.0 - self.min_diameter_mm / self.reference_diameter_mm)
    }
}

/// A vessel with its diameters, straightened: it continues through bifurcations.
#[derive(Debug, Clone, PartialEq)]
pub struct StraightVessel {
    /// Branch and point of each place.
    pub places: Vec<(usize, usize)>,
    /// Length along the vessels from the root of the tree to each place, mm.
    pub along_mm: Vec<f64>,
    /// Diameter at each place without the field's blur along the vessel, mm.
    pub diameter_mm: Vec<f64>,
    /// Reference diameter at each place, mm.
    pub reference_mm: Vec<f64>,
    /// Stenoses of the vessel.
    pub lesions: Vec<Lesion>,
}

impl StraightVessel {
    /// Returns the narrowings, as shares of the reference diameter, at those of some places that lie in the vessel.
    fn narrowings(&self, places: &[(usize, usize)]) -> impl Iterator<Item = f64> {
        let at = |place: &(usize, usize)| self.places.iter().position(|own| own == place);
        places.iter().filter_map(at).map(|i| 1.0 - self.diameter_mm[i] / self.reference_mm[i])
    }
}

/// A vessel that continues through bifurcations, as points of the branches that it consists of.
struct Course {
    /// Branch and point of each place.
    places: Vec<(usize, usize)>,
    /// Length along the vessels from the root to each place, mm.
    along_mm: Vec<f64>,
    radius_mm: Vec<f64>,
    /// Length at the start that lies inside the vessel from which this one leaves, mm: the radius there.
    inside_mm: f64,
}

/// Finds the stenoses of a tree.
///
/// Branches are joined to vessels that continue through bifurcations. Where radii are those of the field, its blur along a vessel is
/// taken out of the area to second order: A - sigma^2 / 2 A''. The reference is the smooth line of asymmetric least squares (Eilers and Boelens, Baseline
/// correction with asymmetric least squares smoothing, 2005) through the radii: narrowings hardly lower it. Where the vessel is
/// nowhere as wide on one of the sides, the reference is the greatest radius of that side. A lesion is a part
/// whose diameter is below nine tenths of the reference, and somewhere [`MIN_PERCENT`] or more below it. Its core, which is narrowed by more
/// than half of the maximum, lies away from the ends of the vessel, and outside of the vessel from which it leaves.
pub fn lesions(tree: &PhaseTree, measurement: Measurement) -> Vec<Lesion> {
    straight_vessels(tree, measurement).into_iter().flat_map(|vessel| vessel.lesions).collect()
}

/// Vessels of each phase of a beat with the diameters that the field of the phase has, where points are followed.
pub struct MeasuredBeat {
    /// Vessels of each phase; empty where points are not followed, because each phase then has lesions of its own.
    phases: Vec<Vec<StraightVessel>>,
}

impl MeasuredBeat {
    /// Judges the vessels of a beat at each phase.
    pub fn new(beat: &BeatTree) -> MeasuredBeat {
        let vessels = |(tree, radii_mm): (&PhaseTree, &Vec<Vec<f64>>)| {
            let mut measured = tree.clone();
            let branches = measured.branches.iter_mut().zip(radii_mm);
            branches.for_each(|(branch, radius_mm)| branch.radius_mm.clone_from(radius_mm));
            straight_vessels(&measured, Measurement { radii_from: RadiiFrom::Field, ..beat.measurement() })
        };
        MeasuredBeat { phases: beat.phases.iter().zip(&beat.measured_mm).map(vessels).collect() }
    }

    /// Returns the diameter stenosis of a lesion at each phase, percent: the worst place of the narrowed part.
    pub fn percents(&self, lesion: &Lesion) -> Vec<f64> {
        let worst = |vessels: &Vec<StraightVessel>| {
            let narrowings = vessels.iter().flat_map(|vessel| vessel.narrowings(&lesion.places));
            100.0 * narrowings.fold(0.0, f64::max)
        };
        self.phases.iter().map(worst).collect()
    }
}

/// Returns the vessels of a tree with their diameters and stenoses, as [`lesions`] judges them; vessels that are too short to be judged are
/// left out.
pub fn straight_vessels(tree: &PhaseTree, measurement: Measurement) -> Vec<StraightVessel> {
    courses(tree).into_iter().filter_map(|course| course.judged(measurement)).collect()
}

/// Joins the branches of a tree to courses. Each branch belongs to one.
fn courses(tree: &PhaseTree) -> Vec<Course> {
    let mut ends_mm = vec![0.0; tree.branches.len()];
    let mut is_joined = vec![false; tree.branches.len()];
    let mut all = Vec::new();
    // Parents come before their children, so that the first branch that is not joined begins a course.
    for first in 0..tree.branches.len() {
        if is_joined[first] {
            continue;
        }
        let parent = tree.branches[first].parent;
        let inside_mm = parent.and_then(|parent| tree.branches[parent].radius_mm.last().copied()).unwrap_or(0.0);
        let mut course = Course { places: Vec::new(), along_mm: Vec::new(), radius_mm: Vec::new(), inside_mm };
        let mut next = Some(first);
        while let Some(index) = next {
            is_joined[index] = true;
            let start_mm = tree.branches[index].parent.map_or(0.0, |parent| ends_mm[parent]);
            ends_mm[index] = course.append(tree, index, start_mm);
            next = continuation(tree, index);
        }
        all.push(course);
    }
    all
}

/// Returns the branch that continues a branch: of those that leave its end, the one that is wide and keeps the direction.
fn continuation(tree: &PhaseTree, index: usize) -> Option<usize> {
    let incoming = direction(tree.branches[index].points_mm.iter().rev().copied()).map(|back| -back);
    let score = |next: usize| {
        let branch = &tree.branches[next];
        let start = &branch.radius_mm[..branch.radius_mm.len().min(START_POINTS)];
        let width_mm = start.iter().sum::<f64>() / start.len().max(1) as f64;
        let outgoing = direction(branch.points_mm.iter().copied());
        let straight = incoming.zip(outgoing).map_or(0.0, |(a, b)| a.dot(b));
        width_mm * (1.0 + straight)
    };
    let children = (0..tree.branches.len()).filter(|next| tree.branches[*next].parent == Some(index));
    children.max_by(|a, b| score(*a).total_cmp(&score(*b)))
}

/// Returns the direction of the first points of a line; `None` where they lie in one place.
fn direction(points_mm: impl Iterator<Item = DVec3>) -> Option<DVec3> {
    let start: Vec<DVec3> = points_mm.take(START_POINTS).collect();
    (*start.last()? - *start.first()?).try_normalize()
}

impl Course {
    /// Appends a branch that begins at a length along the vessels, mm; returns the length at its end.
    fn append(&mut self, tree: &PhaseTree, index: usize, start_mm: f64) -> f64 {
        let branch = &tree.branches[index];
        // The first point of a continuation is the last of the branch before.
        let skipped = usize::from(!self.places.is_empty());
        let mut along_mm = start_mm;
        let mut before: Option<DVec3> = None;
        for (point, (at, radius)) in branch.points_mm.iter().zip(&branch.radius_mm).enumerate() {
            along_mm += before.map_or(0.0, |before| before.distance(*at));
            before = Some(*at);
            if point >= skipped {
                self.places.push((index, point));
                self.along_mm.push(along_mm);
                self.radius_mm.push(*radius);
            }
        }
        along_mm
    }

    fn judged(self, Measurement { resolution_mm, radii_from }: Measurement) -> Option<StraightVessel> {
        let (blur, min_reference) = match radii_from {
            RadiiFrom::Field => (BLUR, MIN_REFERENCE),
            RadiiFrom::Images => (0.0, MIN_REFERENCE_IN_IMAGES),
        };
        let n = self.places.len();
        if n < 3 {
            return None;
        }
        let (start_mm, end_mm) = (self.along_mm[0], self.along_mm[n - 1]);
        let step_mm = (end_mm - start_mm) / (n - 1) as f64;
        let blurred: Vec<f64> = self.radius_mm.iter().map(|radius| radius * radius).collect();
        let areas = without_blur(&blurred, &vec![blur * resolution_mm / step_mm; n]);
        let radius_mm: Vec<f64> = areas.into_iter().map(f64::sqrt).collect();
        let smooth_mm = reference(&radius_mm, step_mm)?;
        // A vessel that becomes narrower and stays so, as behind a bifurcation, has no stenosis.
        let whole_mm = recovered(&radius_mm, (BESIDE * resolution_mm / step_mm).ceil() as usize);
        let reference_mm: Vec<f64> = smooth_mm.iter().zip(&whole_mm).map(|(a, b)| a.min(*b)).collect();
        let narrowing: Vec<f64> = radius_mm.iter().zip(&reference_mm).map(|(r, whole)| 1.0 - r / whole).collect();
        let is_inner = |i: usize| {
            let margin_mm = END * resolution_mm;
            self.along_mm[i] - start_mm > margin_mm + self.inside_mm && end_mm - self.along_mm[i] > margin_mm
        };
        let mut found = Vec::new();
        let mut first = 0;
        for part in narrowing.chunk_by(|a, b| (*a > EDGE) == (*b > EDGE)) {
            let last = first + part.len() - 1;
            let worst = (first..=last).max_by(|a, b| narrowing[*a].total_cmp(&narrowing[*b])).unwrap_or(first);
            let is_wide = 2.0 * reference_mm[worst] >= min_reference * resolution_mm;
            let length_mm = self.along_mm[last] - self.along_mm[first] + step_mm;
            let is_long = length_mm >= MIN_LENGTH * resolution_mm;
            let core = core(&narrowing, worst);
            let is_inside = is_inner(*core.start()) && is_inner(*core.end());
            if 100.0 * narrowing[worst] >= MIN_PERCENT && is_wide && is_long && is_inside {
                let (branch, point) = self.places[worst];
                found.push(Lesion {
                    branch,
                    point,
                    from_root_mm: self.along_mm[worst],
                    length_mm,
                    min_diameter_mm: 2.0 * radius_mm[worst],
                    reference_diameter_mm: 2.0 * reference_mm[worst],
                    places: self.places[first..=last].to_vec(),
                });
            }
            first = last + 1;
        }
        let doubled = |radii: Vec<f64>| radii.into_iter().map(|radius| 2.0 * radius).collect();
        Some(StraightVessel {
            diameter_mm: doubled(radius_mm),
            reference_mm: doubled(reference_mm),
            lesions: found,
            places: self.places,
            along_mm: self.along_mm,
        })
    }
}

/// Returns the places around the greatest narrowing of a lesion where the narrowing exceeds [`CORE`] of it.
fn core(narrowing: &[f64], worst: usize) -> RangeInclusive<usize> {
    let is_core = |share: &&f64| **share > CORE * narrowing[worst];
    let before = narrowing[..worst].iter().rev().take_while(is_core).count();
    let behind = narrowing[worst + 1..].iter().take_while(is_core).count();
    worst - before..=worst + behind
}

/// Returns, for each place, the smaller of the greatest radii before and behind it, within a number of places.
fn recovered(radius_mm: &[f64], places: usize) -> Vec<f64> {
    let greatest = |part: &[f64]| part.iter().copied().fold(0.0, f64::max);
    let at = |i: usize| {
        let (before, behind) = (
            &radius_mm[i.saturating_sub(places)..=i],
            &radius_mm[i..radius_mm.len().min(i.saturating_add(places).saturating_add(1))],
        );
        greatest(before).min(greatest(behind))
    };
    (0..radius_mm.len()).map(at).collect()
}

/// Returns the reference radii for radii at regular steps, mm; `None` where they cannot be found, as with radii that are not finite.
fn reference(radius_mm: &[f64], step_mm: f64) -> Option<Vec<f64>> {
    let n = radius_mm.len();
    let stiffness = (REFERENCE_MM / (TAU * step_mm)).powi(4);
    // The sum of squared second differences.
    let mut bending = Pentadiagonal::zeros(n);
    for middle in 1..n - 1 {
        let terms = [(middle - 1, 1.0), (middle, -2.0), (middle + 1, 1.0)];
        for (a, (i, of_i)) in terms.iter().enumerate() {
            terms[..=a].iter().for_each(|(j, of_j)| bending.add(*i, *j, stiffness * of_i * of_j));
        }
    }
    let mut line = radius_mm.to_vec();
    let mut weights = vec![1.0; n];
    for _ in 0..ROUNDS {
        let mut system = bending.clone();
        (0..n).for_each(|i| system.add(i, i, weights[i]));
        let right: Vec<f64> = radius_mm.iter().zip(&weights).map(|(r, weight)| r * weight).collect();
        line = system.solve(&right)?;
        let weight = |(r, line): (&f64, &f64)| if r > line { ABOVE } else { 1.0 - ABOVE };
        weights = radius_mm.iter().zip(&line).map(weight).collect();
    }
    line.iter().all(|r| r.is_finite() && *r > 0.0).then_some(line)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trees::tree::Branch;

    const STEP_MM: f64 = 0.8;
    const COARSE: Measurement = Measurement { resolution_mm: 1.6, radii_from: RadiiFrom::Field };
    /// Resolution at which a blur of a third of a step is taken out.
    const SHARP: Measurement = Measurement { resolution_mm: 0.8, radii_from: RadiiFrom::Field };

    /// A branch along a direction from a point, with a radius for each length along it, mm.
    fn branch(parent: Option<usize>, from: DVec3, along: DVec3, n: usize, radius: impl Fn(f64) -> f64) -> Branch {
        let at = |i: usize| i as f64 * STEP_MM;
        Branch {
            parent,
            points_mm: (0..n).map(|i| from + along * at(i)).collect(),
            radius_mm: (0..n).map(|i| radius(at(i))).collect(),
            agreement: Vec::new(),
            doubt: Vec::new(),
            gap_mm: 0.0,
        }
    }

    /// A raised cosine that narrows by a share.
    fn narrowed(at_mm: f64, middle_mm: f64, length_mm: f64, share: f64) -> f64 {
        let away = (at_mm - middle_mm) / length_mm;
        if away.abs() < 0.5 { 1.0 - 0.5 * share * (1.0 + (TAU * away).cos()) } else { 1.0 }
    }

    fn tree(branches: Vec<Branch>) -> PhaseTree {
        PhaseTree { phase: 0, branches }
    }

    #[test]
    fn a_stenosis_has_its_diameters_place_and_length() {
        let taper = |mm: f64| 1.6 - 0.008 * mm;
        let vessel = branch(None, DVec3::ZERO, DVec3::X, 101, |mm| taper(mm) * narrowed(mm, 40.0, 12.0, 0.6));
        let sharp = lesions(&tree(vec![vessel.clone()]), SHARP);
        let [lesion] = &sharp[..] else { panic!("{sharp:?}") };
        assert_eq!((lesion.branch, lesion.point), (0, 50));
        assert!((lesion.from_root_mm - 40.0).abs() < 1e-9);
        assert!((lesion.min_diameter_mm - 2.0 * taper(40.0) * 0.4).abs() < 0.03, "{lesion:?}");
        assert!((lesion.reference_diameter_mm / (2.0 * taper(40.0)) - 1.0).abs() < 0.05, "{lesion:?}");
        assert!((lesion.percent() - 60.0).abs() < 3.0, "{lesion:?}");
        // A raised cosine of 60 % exceeds a tenth over 73 % of its length.
        assert!((lesion.length_mm - 0.73 * 12.0).abs() < 2.0 * STEP_MM, "{lesion:?}");
        let blurred = lesions(&tree(vec![vessel]), COARSE);
        assert!(blurred[0].min_diameter_mm < lesion.min_diameter_mm, "{blurred:?}");
    }

    #[test]
    fn a_stenosis_has_its_percentage_at_each_phase_of_the_beat() {
        let with = |share: f64| {
            tree(vec![branch(None, DVec3::ZERO, DVec3::X, 101, |mm| 1.5 * narrowed(mm, 40.0, 12.0, share))])
        };
        let mut beat = BeatTree {
            reference_phase: Some(0),
            threshold_per_mm: 1.0,
            resolution_mm: SHARP.resolution_mm,
            spacing_mm: 0.4,
            vessel_per_mm: None,
            radii_from: RadiiFrom::Field,
            views: Vec::new(),
            phases: vec![with(0.6); 3],
            measured_mm: [0.6, 0.5, 0.0].map(|share| vec![with(share).branches[0].radius_mm.clone()]).into(),
        };
        let found = lesions(&beat.phases[0], SHARP);
        let percents = MeasuredBeat::new(&beat).percents(&found[0]);
        let off = percents.iter().zip([60.0, 50.0, 0.0]).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(percents.len() == 3 && off < 3.0, "{percents:?}");
        assert_eq!(percents[0], found[0].percent());
        beat.measured_mm.clear();
        assert!(MeasuredBeat::new(&beat).percents(&found[0]).is_empty(), "each phase has lesions of its own");
    }

    #[test]
    fn tapers_bifurcations_and_small_variations_are_no_lesions() {
        let wavy = |mm: f64| (1.7 - 0.006 * mm) * (1.0 + 0.08 * (0.35 * mm).sin());
        let trunk = branch(None, DVec3::ZERO, DVec3::X, 60, wavy);
        let end = trunk.points_mm[59];
        // It begins as wide as the trunk, and stays narrower.
        let step = |mm: f64| 0.6 + 0.4 * (-mm / 3.0).exp();
        let main = branch(Some(0), end, DVec3::X, 60, |mm| step(mm) * wavy(mm + 47.0));
        let side = branch(Some(0), end, DVec3::Y, 60, |mm| 0.8 - 0.004 * mm);
        let found = lesions(&tree(vec![trunk, side, main]), COARSE);
        assert_eq!(found, [], "a healthy tree");
    }

    #[test]
    fn a_vessel_continues_through_a_bifurcation() {
        let trunk = branch(None, DVec3::ZERO, DVec3::X, 30, |_| 1.5);
        let end = trunk.points_mm[29];
        // The lesion begins 6 mm after the bifurcation; the branch alone would be too short to tell its reference.
        let main = branch(Some(0), end, DVec3::X, 26, |mm| 1.5 * narrowed(mm, 10.0, 9.0, 0.5));
        let side = branch(Some(0), end, DVec3::Y, 30, |_| 0.8);
        let found = lesions(&tree(vec![trunk, side, main]), SHARP);
        let [lesion] = &found[..] else { panic!("{found:?}") };
        assert_eq!(lesion.branch, 2);
        assert!((lesion.from_root_mm - (29.0 * STEP_MM + 10.0)).abs() < STEP_MM, "{lesion:?}");
        assert!((lesion.percent() - 50.0).abs() < 4.0, "{lesion:?}");
    }

    #[test]
    fn vessels_thinner_than_the_resolution_and_ends_are_not_judged() {
        let radius = |thin: f64, middle: f64| move |mm: f64| thin * narrowed(mm, middle, 8.0, 0.6);
        let vessel =
            |thin: f64, middle: f64| tree(vec![branch(None, DVec3::ZERO, DVec3::X, 101, radius(thin, middle))]);
        assert_eq!(lesions(&vessel(0.9, 40.0), COARSE).len(), 1);
        assert_eq!(lesions(&vessel(0.75, 40.0), COARSE), [], "1.5 mm at a resolution of 1.6 mm");
        assert_eq!(lesions(&vessel(0.9, 77.0), COARSE), [], "at the end");
    }

    /// A lesion of 70 % that is narrowed by a tenth up to 5 mm before and behind its middle, and by half of its maximum up to 3.5 mm.
    fn long_lesion(middle_mm: f64) -> impl Fn(f64) -> f64 {
        move |mm| 1.5 * narrowed(mm, middle_mm, 18.0, 0.7)
    }

    #[test]
    fn the_core_of_a_lesion_lies_away_from_the_ends() {
        let found = |middle_mm: f64| {
            lesions(&tree(vec![branch(None, DVec3::ZERO, DVec3::X, 101, long_lesion(middle_mm))]), COARSE)
        };
        let margin_mm = END * COARSE.resolution_mm;
        let at_start = found(6.5);
        let [lesion] = &at_start[..] else { panic!("{at_start:?}") };
        assert!((lesion.from_root_mm - 6.5).abs() < 2.0 * STEP_MM, "{lesion:?}");
        let [(_, first), .., (_, last)] = lesion.places[..] else { panic!("{lesion:?}") };
        let (first_mm, last_mm) = (first as f64 * STEP_MM, last as f64 * STEP_MM);
        assert!(first_mm < margin_mm, "a tenth begins within the end: {first_mm}");
        assert!((lesion.length_mm - (last_mm - first_mm + STEP_MM)).abs() < 1e-9, "{lesion:?}");
        assert_eq!(found(73.5).len(), 1, "at the other end");
        assert_eq!((found(5.0), found(75.0)), (Vec::new(), Vec::new()), "the core reaches into an end");
    }

    #[test]
    fn a_vessel_begins_where_it_leaves_the_lumen_of_another_one() {
        let found = |middle_mm: f64| {
            let trunk = branch(None, DVec3::ZERO, DVec3::X, 30, |_| 1.6);
            let end = trunk.points_mm[29];
            let main = branch(Some(0), end, DVec3::X, 30, |_| 1.6);
            let side = branch(Some(0), end, DVec3::Y, 101, long_lesion(middle_mm));
            lesions(&tree(vec![trunk, side, main]), COARSE)
        };
        assert_eq!(found(6.5), [], "the core would be accepted at the start of a vessel that leaves no other one");
        assert!(found(9.0).iter().map(|lesion| lesion.branch).eq([1]), "{:?}", found(9.0));
    }

    #[test]
    fn broken_and_tiny_trees_have_no_lesions() {
        assert_eq!(lesions(&tree(Vec::new()), COARSE), []);
        let nothing = branch(None, DVec3::ZERO, DVec3::X, 50, |_| f64::NAN);
        let two = branch(None, DVec3::ZERO, DVec3::X, 2, |_| 1.0);
        assert_eq!(lesions(&tree(vec![nothing, two]), COARSE), []);
    }
}
