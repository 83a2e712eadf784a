//! Inflow of contrast from the ostium to the ends of the vessels.

use crate::tree::{Branch, Tree};

/// Largest distance between a branch's first point and another branch's centreline at which the branch may leave the other:
/// this multiple of the other's radius plus this length in mm. Branches are assumed to be listed from their beginnings on.
const NEAR_RADII: f64 = 2.0;
const NEAR_MM: f64 = 1.0;
/// Length of the contrast front, as a share of the longest path: the filling rises over it from nothing to full.
const FRONT: f64 = 0.2;

impl Tree {
    /// Fills the tree with contrast that has come a share of the way from the ostium to the farthest end; 0 means no contrast.
    pub fn filled_to(self, share: f64) -> Tree {
        if share >= 1.0 {
            return self;
        }
        let ways_mm = self.ways_mm();
        let longest_mm = ways_mm.iter().flatten().copied().fold(f64::MIN_POSITIVE, f64::max);
        // At a share of 1, the end of the front has reached the farthest end.
        let filled = |way_mm: f64| ((share * (1.0 + FRONT) - way_mm / longest_mm) / FRONT).clamp(0.0, 1.0);
        let branch = |(branch, ways_mm): (Branch, Vec<f64>)| Branch {
            filling: branch.filling.iter().zip(ways_mm).map(|(full, way_mm)| full * filled(way_mm)).collect(),
            ..branch
        };
        Tree { branches: self.branches.into_iter().zip(ways_mm).map(branch).collect() }
    }

    /// Path length along the vessels from the nearest root to each point of each branch, mm. Roots are the first points of
    /// branches that do not leave another branch; in a ring of branches, the first point of the branch listed first.
    pub(super) fn ways_mm(&self) -> Vec<Vec<f64>> {
        let along_mm: Vec<Vec<f64>> = self.branches.iter().map(Branch::along_mm).collect();
        let joints: Vec<Vec<Joint>> = (0..self.branches.len()).map(|branch| self.joints(branch, &along_mm)).collect();
        let mut starts_mm: Vec<f64> =
            joints.iter().map(|joints| if joints.is_empty() { 0.0 } else { f64::INFINITY }).collect();
        loop {
            spread(&joints, &mut starts_mm);
            let Some(ring) = starts_mm.iter().position(|start| start.is_infinite()) else { break };
            starts_mm[ring] = 0.0;
        }
        along_mm.into_iter().zip(starts_mm).map(|(along, start)| along.iter().map(|mm| start + mm).collect()).collect()
    }

    /// Joints at which a branch may leave others.
    fn joints(&self, branch: usize, along_mm: &[Vec<f64>]) -> Vec<Joint> {
        let Some(first) = self.branches[branch].points.first() else { return Vec::new() };
        let others = (0..self.branches.len()).filter(|other| *other != branch);
        let shortest = |other: usize| {
            let Branch { points, radius_mm, .. } = &self.branches[other];
            let near = points.iter().zip(radius_mm).zip(&along_mm[other]).filter_map(|((point, radius_mm), way_mm)| {
                let gap_mm = point.distance(*first);
                (gap_mm < NEAR_RADII * radius_mm + NEAR_MM).then_some(way_mm + gap_mm)
            });
            near.reduce(f64::min).map(|way_mm| Joint { other, way_mm })
        };
        others.filter_map(shortest).collect()
    }
}

/// Joint of a branch that begins near another one.
struct Joint {
    other: usize,
    /// Shortest path from the first point of the other branch to the first point of the branch, mm.
    way_mm: f64,
}

/// Propagates path lengths to first points from branch to branch until none becomes shorter.
fn spread(joints: &[Vec<Joint>], starts_mm: &mut [f64]) {
    loop {
        let mut changed = false;
        for (branch, joints) in joints.iter().enumerate() {
            let shortest = joints.iter().map(|j| starts_mm[j.other] + j.way_mm).fold(f64::INFINITY, f64::min);
            if shortest < starts_mm[branch] {
                starts_mm[branch] = shortest;
                changed = true;
            }
        }
        if !changed {
            return;
        }
    }
}

impl Branch {
    /// Path length along the branch from its first point to each of its points, mm.
    fn along_mm(&self) -> Vec<f64> {
        let steps = self.points.windows(2).map(|pair| pair[0].distance(pair[1]));
        let ways = std::iter::once(0.0).chain(steps).scan(0.0, |way, step| {
            *way += step;
            Some(*way)
        });
        ways.collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    /// A straight branch of 11 points.
    fn branch(name: &str, from: DVec3, to: DVec3) -> Branch {
        Branch {
            name: name.to_owned(),
            points: (0..=10).map(|i| from.lerp(to, 0.1 * f64::from(i))).collect(),
            radius_mm: vec![1.0; 11],
            filling: vec![0.5; 11],
        }
    }

    /// A stem of 50 mm, a branch that leaves its end and is listed first, and a vessel with its own ostium.
    fn tree() -> Tree {
        let (end, far) = (DVec3::X * 50.0, DVec3::Y * 200.0);
        let stem = branch("stem", DVec3::ZERO, end);
        let late = branch("late", end + DVec3::Z * 52.0, end + DVec3::new(0.0, 50.0, 52.0));
        let side = branch("side", end + DVec3::Z * 2.0, end + DVec3::Z * 52.0);
        let fork = far + DVec3::X * 30.0;
        let child = branch("child", fork + DVec3::Z, fork + DVec3::Z * 11.0);
        Tree { branches: vec![stem, late, side, child, branch("other", far, fork)] }
    }

    #[test]
    fn ways_go_along_the_vessels() {
        let ways_mm = tree().ways_mm();
        let ends = |i: usize| [ways_mm[i][0], ways_mm[i][10]].map(f64::round);
        assert_eq!([ends(0), ends(1), ends(2)], [[0.0, 50.0], [102.0, 152.0], [52.0, 102.0]]);
        assert_eq!([ends(3), ends(4)], [[31.0, 41.0], [0.0, 30.0]], "from an ostium of their own");
    }

    #[test]
    fn contrast_comes_from_the_ostium_and_fills_everything() {
        let sum = |tree: &Tree, i: usize| tree.branches[i].filling.iter().sum::<f64>();
        let filled = |share: f64| tree().filled_to(share);
        assert!((0..5).all(|i| sum(&filled(0.0), i) == 0.0));
        assert!((0..5).all(|i| (sum(&filled(0.9999), i) - 5.5).abs() < 0.02));
        let half = filled(0.45);
        assert!(sum(&half, 0) > 5.0 && sum(&half, 2) > 0.1 && sum(&half, 2) < 3.0 && sum(&half, 1) == 0.0);
        assert_eq!(sum(&half, 4), 5.5, "each ostium fills its vessels");
    }
}
