//! Vessels as a tree of centrelines with radii, at one phase or followed over the beat. Patient coordinates, LPS mm.

use glam::DVec3;

/// A vessel between two bifurcations, or between a bifurcation and an end.
#[derive(Debug, Clone, PartialEq)]
pub struct Branch {
    /// The branch it leaves, by its place in the tree, always before its own; none for one that begins at a root.
    pub parent: Option<usize>,
    /// Points of the centreline, LPS mm, from the root on; the first is the last of the parent.
    pub points_mm: Vec<DVec3>,
    /// Radius of the lumen at each point, mm.
    pub radius_mm: Vec<f64>,
}

impl Branch {
    /// Length of the centreline, mm.
    pub fn length_mm(&self) -> f64 {
        length_mm(&self.points_mm)
    }

    /// Mean diameter of the lumen along the centreline, mm; of one without length that of its first point.
    pub fn mean_diameter_mm(&self) -> f64 {
        let steps = self.points_mm.windows(2).map(|pair| pair[0].distance(pair[1]));
        // The sum of both radii is the mean diameter of a step.
        let area: f64 = steps.zip(self.radius_mm.windows(2)).map(|(step, r)| step * (r[0] + r[1])).sum();
        let length = self.length_mm();
        let first = self.radius_mm.first().map_or(f64::NAN, |radius| 2.0 * radius);
        if length > 0.0 { area / length } else { first }
    }

    /// Least diameter of the lumen, mm.
    pub fn least_diameter_mm(&self) -> f64 {
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
    /// Branches, each behind its parent.
    pub branches: Vec<Branch>,
}

impl PhaseTree {
    /// Length of all centrelines, mm.
    pub fn length_mm(&self) -> f64 {
        self.branches.iter().map(Branch::length_mm).sum()
    }

    /// Trees it consists of: branches without a parent.
    pub fn components(&self) -> usize {
        self.branches.iter().filter(|branch| branch.parent.is_none()).count()
    }
}

/// Vessels over the beat.
#[derive(Debug, Clone, PartialEq)]
pub struct BeatTree {
    /// The phase whose points are followed: point i of branch b is the same material point in all phases. None where the
    /// moving field carries no points: then each phase has a tree of its own.
    pub reference_phase: Option<u32>,
    /// The field is vessel above this, per mm.
    pub threshold_per_mm: f64,
    /// What the field resolves, mm: the unit of the rules by which trees are made.
    pub resolution_mm: f64,
    /// Distance of the points at which the field was looked at, mm; the largest of all phases.
    pub spacing_mm: f64,
    /// Phases, in the order they were asked for.
    pub phases: Vec<PhaseTree>,
}
