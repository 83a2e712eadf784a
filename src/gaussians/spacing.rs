//! Distances of points to their neighbours, which are the first scales of Gaussians at these points.

use glam::DVec3;
use rayon::prelude::*;

/// Neighbours whose mean squared distance is the squared scale of a Gaussian.
const NEIGHBOURS: usize = 3;
/// Mean number of points in a cell of the grid in which neighbours are looked for.
const POINTS_PER_CELL: f64 = 2.0;
/// Root of the mean squared distance of each point to the nearest three other points; to all other points where there are
/// fewer, and the volume's side without any.
pub(crate) fn spacings(points: &[DVec3]) -> Vec<f64> {
    let grid = PointGrid::new(points);
    (0..points.len())
        .into_par_iter()
        .map(|i| {
            let near = grid.nearest_squared(points, i);
            if near.is_empty() { 2.0 } else { (near.iter().sum::<f64>() / near.len() as f64).sqrt() }
        })
        .collect()
}

/// Points of the volume by cell.
struct PointGrid {
    side: usize,
    cells: Vec<Vec<u32>>,
}

impl PointGrid {
    fn new(points: &[DVec3]) -> PointGrid {
        let side = ((points.len() as f64 / POINTS_PER_CELL).cbrt() as usize).max(1);
        let mut grid = PointGrid { side, cells: vec![Vec::new(); side.pow(3)] };
        for (i, x) in points.iter().enumerate() {
            let cell = grid.index(grid.cell(*x));
            grid.cells[cell].push(i as u32);
        }
        grid
    }

    fn cell(&self, x: DVec3) -> [usize; 3] {
        let along = |v: f64| ((0.5 * (v + 1.0) * self.side as f64) as usize).min(self.side - 1);
        x.to_array().map(along)
    }

    fn index(&self, [x, y, z]: [usize; 3]) -> usize {
        (z * self.side + y) * self.side + x
    }

    /// Squared distances to the nearest of the other points, shell by shell of cells, until no further shell can hold a
    /// nearer one.
    fn nearest_squared(&self, points: &[DVec3], of: usize) -> Vec<f64> {
        let (mut best, home) = (Vec::new(), self.cell(points[of]));
        let width = 2.0 / self.side as f64;
        for shell in 0..self.side {
            let nearest_there = width * (shell as f64 - 1.0).max(0.0);
            if best.len() == NEIGHBOURS && best[NEIGHBOURS - 1] <= nearest_there.powi(2) {
                break;
            }
            for other in self.shell(home, shell).flat_map(|cell| &self.cells[cell]).filter(|k| **k as usize != of) {
                let away = points[of].distance_squared(points[*other as usize]);
                let at = best.partition_point(|d| *d <= away);
                if at < NEIGHBOURS {
                    best.insert(at, away);
                    best.truncate(NEIGHBOURS);
                }
            }
        }
        best
    }

    /// Cells at exactly the distance `shell` from `home`, counted in cells.
    fn shell(&self, home: [usize; 3], shell: usize) -> impl Iterator<Item = usize> + '_ {
        let range = move |at: usize| at.saturating_sub(shell)..=(at + shell).min(self.side - 1);
        range(home[2]).flat_map(move |z| {
            range(home[1]).flat_map(move |y| {
                let edge = z.abs_diff(home[2]) == shell || y.abs_diff(home[1]) == shell;
                range(home[0]).filter(move |x| edge || x.abs_diff(home[0]) == shell).map(move |x| self.index([x, y, z]))
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{STREAM_JITTER, uniform01};

    #[test]
    fn nothing_nearer_is_passed_over() {
        for n in [1, 2, 3, 4, 5, 200] {
            // Crowded in a corner, and a few elsewhere.
            let anywhere =
                |i: usize| DVec3::from_array([0, 1, 2].map(|k| 2.0 * uniform01(3, STREAM_JITTER, i as u32, k) - 1.0));
            let points: Vec<DVec3> =
                (0..n).map(|i| if i % 7 == 0 { anywhere(i) } else { 0.1 * anywhere(i) - 0.8 }).collect();
            for (i, spacing) in spacings(&points).into_iter().enumerate() {
                let mut all: Vec<f64> =
                    (0..n).filter(|k| *k != i).map(|k| points[i].distance_squared(points[k])).collect();
                all.sort_by(f64::total_cmp);
                all.truncate(NEIGHBOURS);
                let want = if all.is_empty() { 2.0 } else { (all.iter().sum::<f64>() / all.len() as f64).sqrt() };
                assert!((spacing - want).abs() < 1e-12, "{n} {i}: {spacing} {want}");
            }
        }
    }
}
