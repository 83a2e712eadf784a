//! Vessels as a tree of centrelines with radii, at one phase or followed over the beat; patient coordinates, LPS mm.

use glam::DVec3;

/// A vessel between two bifurcations, or between a bifurcation and an end.
#[derive(Debug, Clone, PartialEq)]
pub struct Branch {
    /// Index of the branch it leaves, always smaller than its own; `None` for one that begins at a root.
    pub parent: Option<usize>,
    /// Points of the centreline, LPS mm, in order from the root; the first is the last of the parent.
    pub points_mm: Vec<DVec3>,
    /// Radius of the lumen at each point, mm.
    pub radius_mm: Vec<f64>,
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

    /// Number of connected trees: branches without a parent.
    pub fn components(&self) -> usize {
        self.branches.iter().filter(|branch| branch.parent.is_none()).count()
    }
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
    /// Phases, in the order of the request.
    pub phases: Vec<PhaseTree>,
}
