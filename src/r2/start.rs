//! Start of a fit: at voxels that a filtered back-projection shows, or anywhere in the volume.

use crate::config::R2Start;
use crate::config::sections::R2;
use crate::fitting::sets::seed_of_set;
use crate::kernels::layout::R2Gaussian;
use crate::r2::data::R2Data;
use crate::r2::fdk::back_projection;
use crate::r2::parameters::{ScaleBounds, round};
use crate::random::{STREAM_JITTER, STREAM_PLACE, permute, uniform01};
use glam::DVec3;
use rayon::prelude::*;

/// Neighbours whose mean squared distance is the squared scale of a Gaussian.
const NEIGHBOURS: usize = 3;
/// Mean number of points in a cell of the grid in which neighbours are looked for.
const POINTS_PER_CELL: f64 = 2.0;
/// Minimum density that can be stored and fitted.
const LEAST_DENSITY: f64 = 1e-9;

/// First Gaussians of all sets, and notes about them for the user.
pub fn first_rows(data: &R2Data, settings: &R2, seed: u32) -> (Vec<R2Gaussian>, Vec<String>) {
    let (mut rows, mut notes) = (Vec::new(), Vec::new());
    for set in 0..data.n_sets() {
        let (places, note) = places(data, settings, seed, set);
        notes.extend(note);
        rows.extend(gaussians(&places, ScaleBounds::of(settings), set as u32));
    }
    (rows, notes)
}

/// Centres and densities of a set, and the reason if they are not those that were asked for.
fn places(data: &R2Data, settings: &R2, seed: u32, set: usize) -> (Vec<(DVec3, f64)>, Option<String>) {
    let count = settings.count as usize;
    if settings.init == R2Start::Random {
        return (anywhere(count, seed_of_set(seed, set)), None);
    }
    let side = settings.voxels as usize;
    let volume = back_projection(data, set, side);
    let candidates: Vec<usize> = (0..volume.len()).filter(|k| f64::from(volume[*k]) > settings.candidate).collect();
    if candidates.len() < count {
        let name = data.name_of_set(set);
        let note = format!(
            "the back-projection of {name} is above {} at {} voxels, which are too few for the {count} initial \
             Gaussians: they start at random places. Lower r2.count or r2.candidate or raise r2.voxels, or set r2.init \
             = \"random\" to choose random places",
            settings.candidate,
            candidates.len()
        );
        return (anywhere(count, seed_of_set(seed, set)), Some(note));
    }
    let voxel = 2.0 / side as f64;
    let drawn = (0..count).map(|i| {
        let n = candidates.len() as u32;
        let k = candidates[permute(i as u32, n, seed_of_set(seed, set), 0, STREAM_PLACE) as usize];
        let index = DVec3::new((k % side) as f64, (k / side % side) as f64, (k / side / side) as f64);
        // The reference code takes the voxel's corner instead of its centre.
        (voxel * index - 1.0, settings.density_share * f64::from(volume[k]))
    });
    (drawn.collect(), None)
}

/// Points uniform in the volume, with densities from 0 to 1.
fn anywhere(count: usize, seed: u32) -> Vec<(DVec3, f64)> {
    let value = |i: usize, k: u32| uniform01(seed, STREAM_JITTER, i as u32, k);
    (0..count).map(|i| (DVec3::from_array([0, 1, 2].map(|k| 2.0 * value(i, k) - 1.0)), value(i, 3))).collect()
}

/// Round Gaussians as wide as the distance to their neighbours.
fn gaussians(places: &[(DVec3, f64)], bounds: ScaleBounds, set: u32) -> Vec<R2Gaussian> {
    let points: Vec<DVec3> = places.iter().map(|(x, _)| *x).collect();
    let spacings = spacings(&points);
    let pairs = places.iter().zip(spacings);
    pairs.map(|((x, density), scale)| round(*x, density.max(LEAST_DENSITY), scale, bounds, set)).collect()
}

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

    #[test]
    fn nothing_nearer_is_passed_over() {
        for n in [1, 2, 3, 4, 5, 200] {
            // Crowded in a corner, and a few elsewhere.
            let points: Vec<DVec3> = anywhere(n, 3)
                .iter()
                .enumerate()
                .map(|(i, (x, _))| if i % 7 == 0 { *x } else { 0.1 * *x - 0.8 })
                .collect();
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
