//! Extraction of a model's vessels as trees.

mod branches;
mod follow;
pub(in crate::trees) mod graph;
mod radii;
mod solid;
mod tidy;

use crate::error::{Error, Result};
use crate::export::volumes::grid_over;
use crate::gaussians::field::GaussianField;
use crate::geometry::{MM_PER_UNIT, world_from_lps_mm};
use crate::model::Model;
use crate::model::component::Component;
use crate::render::grid::PatientGrid;
use crate::render::renderer::Renderer;
use crate::trees::extract::branches::chains;
use crate::trees::extract::follow::Carrier;
use crate::trees::extract::graph::Forest;
use crate::trees::extract::radii::Lumen;
use crate::trees::extract::solid::make_solid;
use crate::trees::extract::tidy::{bridge_gaps, bridge_stenoses, drop_specks, prune_spurs};
use crate::trees::refine::{Centring, STEP, evenly, from_voxels};
use crate::trees::sampled::SampledField;
use crate::trees::tree::{BeatTree, Branch, PhaseTree, RadiiFrom};
use crate::vessels::centreline::centreline;
use crate::vessels::distances::DistanceMap;
use crate::vessels::field::{Corners, VesselField};
use crate::vessels::mask::Mask;
use crate::vessels::threshold::vessel_threshold_per_mm;
use glam::DVec3;

/// Step of the grid on which a field is sampled, in units of the field's resolution.
const GRID_STEP: f64 = 0.5;
/// Maximum number of points of that grid; vessels that need more are sampled more coarsely.
const MAX_POINTS: f64 = (1u64 << 26) as f64;
/// Resolution of a field of Gaussians, in units of their minimum standard deviation.
const RESOLVED_DEVIATIONS: f64 = 2.5;
/// Minimum length of a branch, in units of the field's resolution.
const MIN_BRANCH: f64 = 3.0;
/// Number of times that lines are moved to the ridge.
const CENTRINGS: usize = 2;
/// Distance from a centreline to which the field is sampled for its profiles, in units of the vessel's radius.
const PROFILE_REACH: f64 = 2.5;

/// Options of the extraction of trees.
#[derive(Debug, Clone, PartialEq)]
pub struct TreeOptions {
    /// Phases, from 0.
    pub phases: Vec<u32>,
    /// Threshold above which the field is vessel, per mm; by default that of scoring ([`vessel_threshold_per_mm`]).
    pub threshold_per_mm: Option<f64>,
    /// Minimum reach of a branch with an end beyond the lumen of its parent, mm; shorter branches are spurs. The default is
    /// three times the field's resolution.
    pub least_branch_mm: Option<f64>,
}

/// Extracts the vessels of a model as trees of centrelines with radii. Where one set of Gaussians moves, the tree of their
/// phase of rest is followed: point i of branch b is the same material point in all phases, with one radius, and motion
/// along vessels, which projections do not show, is determined by the Gaussians' grid. Otherwise each phase has a tree of
/// its own. `progress` is called with the number of finished phases and of all phases, also before the first one; its error
/// ends the work.
///
/// # Errors
/// [`Error::Config`] for a phase that the model does not have, for lengths and thresholds that are not positive, and for a
/// phase without vessels above the threshold; device errors; errors of `progress`.
pub fn vessel_trees(
    renderer: &Renderer,
    model: &Model,
    options: &TreeOptions,
    mut progress: impl FnMut(u64, u64) -> Result<()>,
) -> Result<BeatTree> {
    options.phases.iter().try_for_each(|phase| renderer.check_phase(*phase))?;
    let all = options.phases.len() as u64;
    progress(0, all)?;
    let mut finder = Finder::new(renderer, model, options)?;
    let moving = model.gaussians.as_ref().and_then(GaussianField::moving);
    let (mut phases, mut measured_mm) = (Vec::new(), Vec::new());
    if let Some(tree) = moving {
        let reference = finder.tree(tree.setup.rest_phase)?;
        let carrier = Carrier::new(tree);
        for phase in &options.phases {
            let (tree, radii_mm) = finder.followed(&reference, &carrier, *phase)?;
            phases.push(tree);
            measured_mm.push(radii_mm);
            progress(phases.len() as u64, all)?;
        }
    } else {
        for phase in &options.phases {
            phases.push(finder.tree(*phase)?);
            progress(phases.len() as u64, all)?;
        }
    }
    let is_filled_over_time = moving.is_some_and(|set| set.filling.is_some());
    Ok(BeatTree {
        reference_phase: moving.map(|tree| tree.setup.rest_phase),
        threshold_per_mm: finder.threshold_per_mm,
        resolution_mm: finder.resolution_mm,
        spacing_mm: finder.spacing_mm,
        vessel_per_mm: finder.vessel_per_mm().filter(|_| !is_filled_over_time),
        radii_from: RadiiFrom::Field,
        views: Vec::new(),
        phases,
        measured_mm,
    })
}

/// Returns a positive number; other numbers are an error.
fn positive(name: &str, value: f64) -> Result<f64> {
    if value.is_finite() && value > 0.0 {
        return Ok(value);
    }
    Err(Error::config(name, value, "is not a positive number"))
}

/// State of the extraction of a model's vessels.
struct Finder<'a> {
    renderer: &'a Renderer,
    model: &'a Model,
    pixel_mm: f64,
    resolution_mm: f64,
    threshold_per_mm: f64,
    least_branch_mm: f64,
    /// The largest grid step used so far, mm.
    spacing_mm: f64,
}

impl Finder<'_> {
    fn new<'a>(renderer: &'a Renderer, model: &'a Model, options: &TreeOptions) -> Result<Finder<'a>> {
        let c_arm = &model.c_arm;
        let pixel_mm = c_arm.pixel_mm[0] * c_arm.sod_mm / c_arm.sid_mm;
        let min_deviation_mm = model.gaussians.as_ref().map_or(0.0, |gaussians| {
            let rows = gaussians.rows();
            f64::from(rows.setup.min_scale) * rows.units.pixel * MM_PER_UNIT
        });
        let resolution_mm = pixel_mm.max(RESOLVED_DEVIATIONS * min_deviation_mm);
        let threshold_per_mm = match options.threshold_per_mm {
            Some(threshold) => positive("threshold_per_mm", threshold)?,
            None => {
                let grid = grid_over(&model.scene, Component::Dynamic, resolution_mm)?;
                vessel_threshold_per_mm(renderer, model, &grid)?
            }
        };
        let least_branch_mm =
            options.least_branch_mm.map_or(Ok(MIN_BRANCH * resolution_mm), |mm| positive("least_branch_mm", mm))?;
        let finder =
            Finder { renderer, model, pixel_mm, resolution_mm, threshold_per_mm, least_branch_mm, spacing_mm: 0.0 };
        // The rule gives zero where the field vanishes at the first phase.
        if threshold_per_mm > 0.0 { Ok(finder) } else { Err(finder.no_vessels(0)) }
    }

    fn no_vessels(&self, phase: u32) -> Error {
        let problem = format!(
            "at phase {phase}, the dynamic field has no vessel above this threshold that is longer than {:.2} mm: try \
             a lower threshold, or check in the run's report whether the dynamic field shows vessels",
            self.least_branch_mm
        );
        Error::config("threshold_per_mm", format!("{:.3e}", self.threshold_per_mm), problem)
    }

    /// Returns the dynamic field at a phase.
    fn vessel_field(&self, phase: u32) -> VesselField<'_> {
        let Finder { renderer, model, pixel_mm, threshold_per_mm, .. } = *self;
        VesselField { renderer, scene: &model.scene, phase, pixel_mm, threshold_per_mm }
    }

    /// Samples the field of a phase inside boxes; `None` without boxes.
    fn field(&mut self, phase: u32, boxes: &[Corners]) -> Result<Option<SampledField>> {
        let Some(reach) = boxes.iter().copied().reduce(Corners::joined) else { return Ok(None) };
        let extent_mm = reach.high_mm - reach.low_mm;
        let fitting_mm = (extent_mm.element_product() / MAX_POINTS).cbrt();
        let spacing_mm = fitting_mm.max(GRID_STEP * self.resolution_mm);
        self.spacing_mm = self.spacing_mm.max(spacing_mm);
        let size = ((extent_mm / spacing_mm).ceil().as_uvec3() + 1).to_array();
        let grid = PatientGrid { origin_mm: reach.low_mm, spacing_mm: DVec3::splat(spacing_mm), size };
        let mut values = vec![0f32; size.iter().map(|n| *n as usize).product()];
        self.vessel_field(phase).rows(boxes, &grid, |first, row| values[first..][..row.len()].copy_from_slice(row))?;
        Ok(Some(SampledField { grid, values }))
    }

    /// Extracts the tree of a single phase.
    fn tree(&mut self, phase: u32) -> Result<PhaseTree> {
        let field = self.vessel_field(phase);
        let boxes = field.boxes(&field.coarse()?);
        let mut field = self.field(phase, &boxes)?.ok_or_else(|| self.no_vessels(phase))?;
        let vessels = make_solid(&mut field, self.threshold_per_mm, self.resolution_mm, self.vessel_per_mm());
        let lines = centrelines(&field, &vessels, self.resolution_mm, self.least_branch_mm);
        if lines.is_empty() {
            return Err(self.no_vessels(phase));
        }
        Ok(PhaseTree { phase, branches: self.measured(&field, lines, phase) })
    }

    /// Returns the attenuation inside vessels, where it is known.
    fn vessel_per_mm(&self) -> Option<f64> {
        self.model.vessel_attenuation.map(|attenuation| attenuation / MM_PER_UNIT)
    }

    /// Moves the tree of the reference phase to another phase, where a material point keeps its radius. Returns also the radii of the branches
    /// as the field of the phase has them, mm.
    fn followed(
        &mut self,
        reference: &PhaseTree,
        carrier: &Carrier<'_>,
        phase: u32,
    ) -> Result<(PhaseTree, Vec<Vec<f64>>)> {
        if phase == reference.phase {
            let radii_mm = reference.branches.iter().map(|branch| branch.radius_mm.clone()).collect();
            return Ok((reference.clone(), radii_mm));
        }
        let carried: Vec<Vec<DVec3>> =
            reference.branches.iter().map(|branch| carrier.carried_mm(&branch.points_mm, phase)).collect();
        let around = |(branch, line): (&Branch, &Vec<DVec3>)| -> Vec<Corners> {
            let reach_mm = |radius_mm: f64| (Centring::REACH * self.resolution_mm).max(PROFILE_REACH * radius_mm);
            line.iter().zip(&branch.radius_mm).map(|(point, r)| Corners::around(*point, reach_mm(*r))).collect()
        };
        let boxes: Vec<Corners> = reference.branches.iter().zip(&carried).flat_map(around).collect();
        let field = self.field(phase, &boxes)?.ok_or_else(|| self.no_vessels(phase))?;
        let centring = Centring { field: &field, resolution_mm: self.resolution_mm };
        let mut branches: Vec<Branch> = Vec::new();
        for (branch, mut points_mm) in reference.branches.iter().zip(carried) {
            let start = branch.parent.and_then(|parent| branches[parent].points_mm.last().copied());
            points_mm[0] = start.unwrap_or(points_mm[0]);
            let points_mm = centring.line(&points_mm, start.is_some());
            branches.push(Branch { points_mm, ..branch.clone() });
        }
        let lumen = self.lumen(&field);
        let radii_mm = branches.iter().map(|branch| lumen.radii_mm(&branch.points_mm)).collect();
        Ok((PhaseTree { phase, branches }, radii_mm))
    }

    /// Returns the measurement of radii in a field.
    fn lumen<'a>(&self, field: &'a SampledField) -> Lumen<'a> {
        Lumen { field, resolution_mm: self.resolution_mm, vessel_per_mm: self.vessel_per_mm() }
    }

    /// Returns the share of the other fits that have a vessel at each point; empty for a single fit.
    fn agreement(&self, points_mm: &[DVec3], phase: u32) -> Vec<f64> {
        let Some(gaussians) = &self.model.gaussians else { return Vec::new() };
        let pixel = gaussians.rows().units.pixel;
        let points: Vec<DVec3> = points_mm.iter().map(|point| world_from_lps_mm(*point) / pixel).collect();
        gaussians.agreement_at(&points, phase as usize).unwrap_or_default()
    }

    /// Measures the radii of the vessels along lines at a phase, and how far repeated fits agree on them.
    fn measured(&self, field: &SampledField, lines: Vec<Line>, phase: u32) -> Vec<Branch> {
        let lumen = self.lumen(field);
        let branch = |Line { parent, points_mm, gap_mm }: Line| {
            let radius_mm = lumen.radii_mm(&points_mm);
            let agreement = self.agreement(&points_mm, phase);
            Branch { parent, points_mm, radius_mm, gap_mm, agreement, doubt: Vec::new() }
        };
        lines.into_iter().map(branch).collect()
    }
}

/// A centreline and its parent.
struct Line {
    parent: Option<usize>,
    points_mm: Vec<DVec3>,
    /// Length of the gaps that were bridged, mm.
    gap_mm: f64,
}

/// Centrelines of the vessels of a field, each after its parent.
fn centrelines(field: &SampledField, vessels: &Mask, resolution_mm: f64, least_branch_mm: f64) -> Vec<Line> {
    let mut forest = thinned(field, vessels);
    bridge_gaps(&mut forest, resolution_mm);
    prune_spurs(&mut forest, least_branch_mm);
    bridge_stenoses(&mut forest, resolution_mm);
    drop_specks(&mut forest, least_branch_mm);
    let centring = Centring { field, resolution_mm };
    let mut lines: Vec<Line> = Vec::new();
    for chain in chains(&forest) {
        let mut points_mm = forest.places_mm(&chain.nodes);
        // Voxels that touch are less than two steps of the grid apart.
        let touching_mm = 2.0 * field.grid.spacing_mm.max_element();
        // The sum of no numbers is -0, which would be written into files.
        let links_mm = points_mm.windows(2).map(|pair| pair[0].distance(pair[1]));
        let gap_mm = links_mm.filter(|link_mm| *link_mm > touching_mm).fold(0.0, |all_mm, link_mm| all_mm + link_mm);
        let start = chain.parent.and_then(|parent| lines[parent].points_mm.last().copied());
        points_mm[0] = start.unwrap_or(points_mm[0]);
        let mut points_mm = from_voxels(&points_mm, resolution_mm);
        for _ in 0..CENTRINGS {
            points_mm = evenly(&centring.line(&points_mm, start.is_some()), STEP * resolution_mm);
        }
        lines.push(Line { parent: chain.parent, points_mm, gap_mm });
    }
    lines
}

/// Thins the vessels of a field to a forest of lines one voxel wide.
fn thinned(field: &SampledField, vessels: &Mask) -> Forest {
    let to_outside = DistanceMap::to(&vessels.complement());
    let line = centreline(vessels);
    Forest::of(&line, field, |voxel| to_outside.as_ref().map_or(0.0, |map| f64::from(map.at_mm(voxel))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trees::sampled::tests::{RESOLUTION_MM, Tube, VESSEL_PER_MM, distance_mm, points, vessels};
    use std::f64::consts::TAU;

    fn found(tubes: &[Tube]) -> Vec<Line> {
        found_in(&mut vessels(tubes))
    }

    fn found_in(field: &mut SampledField) -> Vec<Line> {
        let vessels = make_solid(field, 0.2 * VESSEL_PER_MM, RESOLUTION_MM, Some(VESSEL_PER_MM));
        centrelines(field, &vessels, RESOLUTION_MM, MIN_BRANCH * RESOLUTION_MM)
    }

    /// Maximum distance of a line's points from the nearest true point, mm.
    fn farthest_mm(line: &[DVec3], truth: &[DVec3]) -> f64 {
        line.iter().map(|point| distance_mm(truth, *point)).fold(0.0, f64::max)
    }

    #[test]
    fn a_helix_is_its_middle() {
        let helix = points(2000, |along| {
            let (sine, cosine) = (2.0 * TAU * along).sin_cos();
            DVec3::new(10.0 * cosine, 10.0 * sine, 30.0 * along - 15.0)
        });
        let lines = found(&[(helix.clone(), 1.2)]);
        assert_eq!(lines.len(), 1);
        let line = &lines[0].points_mm;
        assert!(farthest_mm(line, &helix) < 0.15, "{} mm off", farthest_mm(line, &helix));
        // Thinning shortens ends by the radius.
        assert!(farthest_mm(&helix, line) < 2.0, "{} mm missing", farthest_mm(&helix, line));
        let steps: Vec<f64> = line.windows(2).map(|pair| pair[0].distance(pair[1])).collect();
        assert!(steps.iter().all(|step| (step / steps[0] - 1.0).abs() < 0.02), "points are even");
    }

    #[test]
    fn a_fork_has_three_branches_that_meet() {
        let fork = DVec3::new(0.0, 0.0, -2.0);
        let arm = |to: DVec3| points(400, |along| fork.lerp(to, along));
        let stem = arm(DVec3::new(0.0, 0.0, -16.0));
        let (left, right) = (arm(DVec3::new(-12.0, 0.0, 13.0)), arm(DVec3::new(12.0, 2.0, 13.0)));
        let lines = found(&[(stem.clone(), 2.0), (left.clone(), 1.3), (right.clone(), 1.3)]);
        let parents: Vec<Option<usize>> = lines.iter().map(|line| line.parent).collect();
        assert_eq!(parents, [None, Some(0), Some(0)], "the widest end is the root");
        assert!(lines[0].points_mm[0].z < -12.0, "the root is the stem's end");
        let end = lines[0].points_mm[lines[0].points_mm.len() - 1];
        assert!(lines[1..].iter().all(|line| line.points_mm[0] == end));
        assert!(end.distance(fork) < 1.5, "they meet at {end}, not {fork}");
        let all = [stem, left, right].concat();
        for line in lines {
            assert!(farthest_mm(&line.points_mm, &all) < 0.4, "{} mm off", farthest_mm(&line.points_mm, &all));
        }
    }

    #[test]
    fn a_ring_is_cut_where_it_is_thinnest() {
        let ring = |from: f64, to: f64| {
            points(800, |along| {
                let (sine, cosine) = (TAU * (from + (to - from) * along)).sin_cos();
                DVec3::new(12.0 * cosine, 12.0 * sine, 0.0)
            })
        };
        // The ring is thin around a quarter of its length.
        let lines = found(&[(ring(0.3, 1.2), 1.5), (ring(0.2, 0.3), 0.6)]);
        let lengths: f64 = lines.iter().map(|line| crate::trees::tree::length_mm(&line.points_mm)).sum();
        assert_eq!(lines.len(), 1, "one open line");
        assert!((0.9..1.0).contains(&(lengths / (TAU * 12.0))), "{lengths} mm");
        let ends = [lines[0].points_mm[0], lines[0].points_mm[lines[0].points_mm.len() - 1]];
        assert!(ends.iter().all(|end| end.x.abs() < 5.0 && end.y > 10.0), "cut in the thin part: {ends:?}");
    }

    #[test]
    fn a_bump_is_no_branch_and_a_side_branch_is_one() {
        let stem = (points(400, |along| DVec3::X * (34.0 * along - 17.0)), 2.0);
        let side = |length: f64| (points(100, |along| DVec3::Y * length * along), 0.8);
        assert_eq!(found(&[stem.clone(), side(3.5)]).len(), 1);
        assert_eq!(found(&[stem.clone(), side(9.0)]).len(), 3);
    }

    /// A field with holes inside thick vessels, as Gaussians leave them: about one in eight places lacks attenuation.
    fn uneven(tubes: &[Tube]) -> SampledField {
        let mut field = vessels(tubes);
        for index in 0..field.values.len() {
            let place = field.place_mm(index) / 3.0;
            let lump = (TAU * place.x).sin() * (TAU * place.y).sin() * (TAU * place.z).sin();
            if lump > 0.5 {
                field.values[index] *= 0.1;
            }
        }
        field
    }

    #[test]
    fn a_straight_tube_of_any_width_is_one_line() {
        let tube =
            |radius_mm: f64, half_mm: f64| (points(300, |along| DVec3::X * half_mm * (2.0 * along - 1.0)), radius_mm);
        // Diameters: a grid step, 4 mm, 16 mm.
        for (radius_mm, half_mm) in [(0.25, 18.0), (2.0, 17.0), (8.0, 11.0)] {
            let lines = found(&[tube(radius_mm, half_mm)]);
            assert_eq!(lines.len(), 1, "radius {radius_mm} mm");
        }
        let mut field = uneven(&[tube(8.0, 11.0)]);
        let lines = found_in(&mut field);
        assert_eq!(lines.len(), 1, "lines of an uneven field");
        assert!(lines[0].gap_mm == 0.0 && lines[0].gap_mm.is_sign_positive(), "no gap");
        let lumen = Lumen { field: &field, resolution_mm: RESOLUTION_MM, vessel_per_mm: Some(VESSEL_PER_MM) };
        let radii_mm = lumen.radii_mm(&lines[0].points_mm);
        let middle = &radii_mm[radii_mm.len() / 4..radii_mm.len() * 3 / 4];
        assert!(middle.iter().all(|radius| (radius / 8.0 - 1.0).abs() < 0.1), "{middle:?} mm");
    }

    #[test]
    fn a_gap_is_closed_and_nothing_has_no_lines() {
        let part = |from: f64, to: f64| (points(200, |along| DVec3::Z * (from + (to - from) * along)), 1.0);
        assert_eq!(found(&[part(-17.0, -1.5), part(1.5, 17.0)]).len(), 1);
        // A severe stenosis, which the line crosses at even steps.
        let lines = found(&[part(-17.0, -5.0), part(5.0, 17.0)]);
        assert_eq!(lines.len(), 1);
        assert!((lines[0].gap_mm - 10.0).abs() < 2.0, "{} mm", lines[0].gap_mm);
        let points_mm = &lines[0].points_mm;
        let steps_mm = points_mm.windows(2).map(|pair| pair[0].distance(pair[1]));
        assert!(steps_mm.fold(0.0, f64::max) < RESOLUTION_MM, "{points_mm:?}");
        assert!(points_mm.iter().all(|p| p.truncate().length() < 0.1), "{points_mm:?}");
        let lines = found(&[part(-17.0, -8.0), part(8.0, 17.0)]);
        assert_eq!(lines.iter().map(|line| line.gap_mm).collect::<Vec<_>>(), [0.0, 0.0]);
        assert!(found(&[]).is_empty());
    }
}
