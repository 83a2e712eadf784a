//! Vessels as a tree of centrelines with radii, at one phase or followed over the beat; patient coordinates, LPS mm.

use crate::geometry::ViewRays;
use crate::raster::percentile;
use crate::scan::dataset::Dataset;
use glam::DVec3;
use serde::Serialize;

/// Share of the other fits below which a place is doubtful. With two views, 50 to 90 % of the places that nearly all fits have are true,
/// and 10 to 50 % of those that fewer than this share have (`docs/performance.md`).
pub const DOUBTFUL: f64 = 0.75;

/// Probability that the interval of a [`Doubt`] contains the true place.
pub const CONFIDENCE: f64 = 0.68;
/// Distance within which a true vessel must lie for a point to exist, mm.
pub const EXISTS_WITHIN_MM: f64 = 3.0;

/// Doubt about a point of a centreline.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Doubt {
    /// Half width, mm, of the interval that contains the true centreline with a probability of [`CONFIDENCE`], along `direction`.
    pub across_mm: f64,
    /// Least certain direction across the vessel, a unit vector (LPS).
    pub direction: DVec3,
    /// Half width, mm, for the material point, along its least certain direction: also along the vessel, where no view shows motion.
    /// `None` where points are not followed, or where the reference phase is not among the phases of the tree.
    pub with_motion_mm: Option<f64>,
    /// Probability that a true vessel is within [`EXISTS_WITHIN_MM`], 0 to 1.
    pub existence: f64,
}

/// A vessel between two bifurcations, or between a bifurcation and an end.
#[derive(Debug, Clone, PartialEq)]
pub struct Branch {
    /// Index of the branch it leaves, always smaller than its own; `None` for one that begins at a root.
    pub parent: Option<usize>,
    /// Points of the centreline, LPS mm, in order from the root; the first is the last of the parent.
    pub points_mm: Vec<DVec3>,
    /// Radius of the lumen at each point, mm.
    pub radius_mm: Vec<f64>,
    /// Length of the parts where the field is below the threshold, mm: gaps across which two centrelines were linked because one points at the
    /// other; 0 for none.
    pub gap_mm: f64,
    /// Share of the other fits that have a vessel at each point, 0 to 1, where the field is the mean of several fits: points with little
    /// agreement may be false crossings. Empty for a single fit.
    pub agreement: Vec<f64>,
    /// Doubt about each point ([`crate::trees::doubt`]); empty where the training images are not known.
    pub doubt: Vec<Doubt>,
}

impl Branch {
    /// Length of the centreline, mm.
    pub fn length_mm(&self) -> f64 {
        length_mm(&self.points_mm)
    }

    /// Mean diameter of the lumen along the centreline, mm; for a centreline of length zero, the diameter at its first
    /// point.
    pub fn mean_diameter_mm(&self) -> f64 {
        let steps = self.points_mm.windows(2).map(|pair| pair[0].distance(pair[1]));
        // The sum of both radii is the mean diameter of a step.
        let area: f64 = steps.zip(self.radius_mm.windows(2)).map(|(step, r)| step * (r[0] + r[1])).sum();
        let length = self.length_mm();
        let first = self.radius_mm.first().map_or(f64::NAN, |radius| 2.0 * radius);
        if length > 0.0 { area / length } else { first }
    }

    /// Mean agreement of repeated fits at the points, 0 to 1; `None` for a single fit.
    pub fn mean_agreement(&self) -> Option<f64> {
        let n = self.agreement.len();
        (n > 0).then(|| self.agreement.iter().sum::<f64>() / n as f64)
    }

    /// Probability that the branch exists: the mean over its points, 0 to 1; `None` where doubt is not stated.
    pub fn existence(&self) -> Option<f64> {
        let n = self.doubt.len();
        (n > 0).then(|| self.doubt.iter().map(|doubt| doubt.existence).sum::<f64>() / n as f64)
    }

    /// Median half width of the intervals of its points, mm; `None` where doubt is not stated.
    pub fn median_doubt_mm(&self) -> Option<f64> {
        let widths: Vec<f32> = self.doubt.iter().map(|doubt| doubt.across_mm as f32).collect();
        (!widths.is_empty()).then(|| f64::from(percentile(&widths, 0.5)))
    }

    /// Minimum diameter of the lumen, mm.
    pub fn min_diameter_mm(&self) -> f64 {
        2.0 * self.radius_mm.iter().copied().fold(f64::INFINITY, f64::min)
    }
}

/// Length of a line through points, mm.
pub(super) fn length_mm(points_mm: &[DVec3]) -> f64 {
    points_mm.windows(2).map(|pair| pair[0].distance(pair[1])).sum()
}

/// The vessels of one phase.
#[derive(Debug, Clone, PartialEq)]
pub struct PhaseTree {
    /// Cardiac phase, from 0.
    pub phase: u32,
    /// Branches, each after its parent.
    pub branches: Vec<Branch>,
}

impl PhaseTree {
    /// Length of all centrelines, mm.
    pub fn length_mm(&self) -> f64 {
        self.branches.iter().map(Branch::length_mm).sum()
    }

    /// Length, mm, of the parts of which less than [`DOUBTFUL`] of the other fits have a vessel; `None` for a single fit.
    pub fn doubtful_mm(&self) -> Option<f64> {
        let of_branch = |branch: &Branch| {
            let steps = branch.points_mm.windows(2).map(|pair| pair[0].distance(pair[1]));
            let doubtful = branch.agreement.windows(2).map(|pair| 0.5 * (pair[0] + pair[1]) < DOUBTFUL);
            steps.zip(doubtful).filter(|(_, doubtful)| *doubtful).map(|(step, _)| step).sum::<f64>()
        };
        let is_known = self.branches.iter().any(|branch| !branch.agreement.is_empty());
        is_known.then(|| self.branches.iter().map(of_branch).sum())
    }

    /// Number of connected trees: branches without a parent.
    pub fn components(&self) -> usize {
        self.branches.iter().filter(|branch| branch.parent.is_none()).count()
    }
}

/// A training view of a tree.
#[derive(Debug, Clone, PartialEq)]
pub struct TreeView {
    /// Index of the view in the dataset.
    pub view: usize,
    /// Primary and secondary angle, degrees, where the geometry is stated by angles.
    pub angles_deg: Option<(f64, f64)>,
    /// Rays as calibrated.
    pub rays: ViewRays,
}

impl TreeView {
    /// Returns the training views of a dataset.
    pub fn of(dataset: &Dataset) -> Vec<TreeView> {
        let of_view = |view: usize| TreeView {
            view,
            angles_deg: dataset.views[view].geometry.angles_deg(),
            rays: dataset.views[view].rays.clone(),
        };
        dataset.training_views().into_iter().map(of_view).collect()
    }
}

/// Source of the radii of a tree.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum RadiiFrom {
    /// The profile of the field across the centrelines ([`crate::trees::extract`]).
    Field,
    /// The training images ([`crate::trees::areas`]).
    Images,
}

/// Measurement of the radii of a tree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// Resolution of the field, mm.
    pub resolution_mm: f64,
    /// Source of the radii.
    pub radii_from: RadiiFrom,
}

/// Vessels over the beat.
#[derive(Debug, Clone, PartialEq)]
pub struct BeatTree {
    /// Reference phase, whose points are followed: point i of branch b is the same material point in all phases. `None`
    /// where the dynamic field does not move points; each phase then has a tree of its own.
    pub reference_phase: Option<u32>,
    /// Threshold above which the field is vessel, per mm.
    pub threshold_per_mm: f64,
    /// Resolution of the field, mm: the unit of the rules of the extraction.
    pub resolution_mm: f64,
    /// Grid step at which the field was sampled, mm; the maximum over all phases.
    pub spacing_mm: f64,
    /// Attenuation of the vessels, per mm, where it is known and the same at all phases.
    pub vessel_per_mm: Option<f64>,
    /// Source of the radii.
    pub radii_from: RadiiFrom,
    /// Training views, in which the sight of stenoses is stated; empty where they are not known.
    pub views: Vec<TreeView>,
    /// Phases, in the order of the request.
    pub phases: Vec<PhaseTree>,
    /// Radii measured in the field of each phase, `[phase in the order above][branch][point]`, mm, where points are followed: such points have
    /// one radius for all phases otherwise. Empty where points are not followed.
    pub measured_mm: Vec<Vec<Vec<f64>>>,
}

impl BeatTree {
    /// Removes the phases that are not among those given.
    pub fn keep_phases(&mut self, phases: &[u32]) {
        let is_kept: Vec<bool> = self.phases.iter().map(|tree| phases.contains(&tree.phase)).collect();
        let mut of_measured = is_kept.iter();
        self.measured_mm.retain(|_| of_measured.next().is_some_and(|kept| *kept));
        self.phases.retain(|tree| phases.contains(&tree.phase));
    }

    /// Returns the measurement of the radii of its phases.
    pub fn measurement(&self) -> Measurement {
        Measurement { resolution_mm: self.resolution_mm, radii_from: self.radii_from }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_that_few_fits_have_are_doubtful() {
        let line = |agreement: &[f64]| Branch {
            parent: None,
            points_mm: (0..4).map(|i| DVec3::X * 2.0 * f64::from(i)).collect(),
            radius_mm: vec![1.0; 4],
            agreement: agreement.to_vec(),
            doubt: Vec::new(),
            gap_mm: 0.0,
        };
        let tree = |branches: Vec<Branch>| PhaseTree { phase: 0, branches };
        let doubt = tree(vec![line(&[1.0, 1.0, 0.4, 0.0]), line(&[1.0; 4])]);
        assert_eq!(doubt.doubtful_mm(), Some(4.0), "two of six steps of 2 mm");
        assert_eq!(doubt.branches[0].mean_agreement(), Some(0.6));
        let single = tree(vec![line(&[])]);
        assert_eq!((single.doubtful_mm(), single.branches[0].mean_agreement()), (None, None));
    }
}
