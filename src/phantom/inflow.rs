//! Contrast on its way from the ostium to the ends of the vessels.

use crate::phantom::tree::{Branch, Tree};

/// A branch leaves another one where its first point lies so near to it, mm beyond the other's radius.
const ATTACHED_MM: f64 = 4.0;
/// Over this share of the longest way, contrast goes from nothing to what there is behind.
const FRONT: f64 = 0.2;

impl Tree {
    /// The tree while contrast has come a share of the way from where it enters to the farthest end; 0 is none at all.
    pub fn filled_to(self, share: f64) -> Tree {
        if share >= 1.0 {
            return self;
        }
        let ways_mm = self.ways_mm();
        let longest_mm = ways_mm.iter().flatten().copied().fold(f64::MIN_POSITIVE, f64::max);
        // At 1 the end of the front has reached the farthest end.
        let filled = |way_mm: f64| ((share * (1.0 + FRONT) - way_mm / longest_mm) / FRONT).clamp(0.0, 1.0);
        let branch = |(branch, ways_mm): (Branch, Vec<f64>)| Branch {
            filling: branch.filling.iter().zip(ways_mm).map(|(full, way_mm)| full * filled(way_mm)).collect(),
            ..branch
        };
        Tree { branches: self.branches.into_iter().zip(ways_mm).map(branch).collect() }
    }

    /// Way along the vessels from the nearest root to each point of each branch, mm. The first branch begins at a root, and so
    /// does each that leaves no other.
    fn ways_mm(&self) -> Vec<Vec<f64>> {
        let along = |branch: &Branch| {
            let steps = branch.points.windows(2).map(|pair| pair[0].distance(pair[1]));
            let ways = std::iter::once(0.0).chain(steps).scan(0.0, |way, step| {
                *way += step;
                Some(*way)
            });
            ways.collect::<Vec<f64>>()
        };
        let mut ways_mm: Vec<Vec<f64>> = self.branches.iter().map(along).collect();
        let mut starts_mm = vec![f64::INFINITY; ways_mm.len()];
        while let Some(root) = starts_mm.iter().position(|start| start.is_infinite()) {
            starts_mm[root] = 0.0;
            // A branch may leave one that is listed behind it.
            for _ in 0..starts_mm.len() {
                for branch in 0..starts_mm.len() {
                    starts_mm[branch] = starts_mm[branch].min(self.start_mm(branch, &ways_mm, &starts_mm));
                }
            }
        }
        for (ways, start) in ways_mm.iter_mut().zip(starts_mm) {
            ways.iter_mut().for_each(|way| *way += start);
        }
        ways_mm
    }

    /// The way to where a branch leaves the nearest point of another, mm; infinite where it leaves none that is reached.
    fn start_mm(&self, branch: usize, along_mm: &[Vec<f64>], starts_mm: &[f64]) -> f64 {
        let Some(first) = self.branches[branch].points.first() else { return f64::INFINITY };
        let others = (0..self.branches.len()).filter(|other| *other != branch);
        let points = others.flat_map(|other| {
            let Branch { points, radius_mm, .. } = &self.branches[other];
            let ways = along_mm[other].iter().map(move |way| starts_mm[other] + way);
            points.iter().zip(radius_mm).zip(ways)
        });
        let attached = points.filter_map(|((point, radius_mm), way_mm)| {
            let gap_mm = point.distance(*first);
            (gap_mm < ATTACHED_MM + radius_mm).then_some(way_mm + gap_mm)
        });
        attached.fold(f64::INFINITY, f64::min)
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

    /// A stem of 50 mm, what leaves its end listed first, and a vessel with an ostium of its own.
    fn tree() -> Tree {
        let (end, far) = (DVec3::X * 50.0, DVec3::Y * 200.0);
        let stem = branch("stem", DVec3::ZERO, end);
        let late = branch("late", end + DVec3::Z * 52.0, end + DVec3::new(0.0, 50.0, 52.0));
        let side = branch("side", end + DVec3::Z * 2.0, end + DVec3::Z * 52.0);
        Tree { branches: vec![stem, late, side, branch("other", far, far + DVec3::X * 30.0)] }
    }

    #[test]
    fn ways_go_along_the_vessels() {
        let ways_mm = tree().ways_mm();
        let ends = |i: usize| [ways_mm[i][0], ways_mm[i][10]].map(f64::round);
        assert_eq!([ends(0), ends(1), ends(2), ends(3)], [[0.0, 50.0], [102.0, 152.0], [52.0, 102.0], [0.0, 30.0]]);
    }

    #[test]
    fn contrast_comes_from_the_ostium_and_fills_everything() {
        let sum = |tree: &Tree, i: usize| tree.branches[i].filling.iter().sum::<f64>();
        let filled = |share: f64| tree().filled_to(share);
        assert!((0..4).all(|i| sum(&filled(0.0), i) == 0.0));
        assert!((0..4).all(|i| (sum(&filled(0.9999), i) - 5.5).abs() < 0.02));
        let half = filled(0.45);
        assert!(sum(&half, 0) > 5.0 && sum(&half, 2) > 0.1 && sum(&half, 2) < 3.0 && sum(&half, 1) == 0.0);
        assert_eq!(sum(&half, 3), 5.5, "each ostium fills its vessels");
    }
}
