//! Separation of connected Gaussians, which represent vessels, from isolated ones.

use crate::gaussians::field::scales;
use crate::kernels::layout::{Gaussian, GaussianSetup};
use crate::raster::percentile;
use glam::{DVec3, IVec3};
use std::collections::HashMap;

/// Minimum number of connected Gaussians that form a piece of a vessel.
const MIN_OF_A_VESSEL: usize = 4;
/// Percentile of the breadths of connected Gaussians that is taken as the breadth of vessels.
const BROAD_PERCENTILE: f64 = 0.95;
/// Factor on the breadth of vessels above which an isolated Gaussian is no vessel.
const BROADER: f64 = 1.2;

/// Tells for each Gaussian whether it may be part of a vessel: it is connected with others of its phase, neighbours being at
/// most `link` pixels apart, or it is not broader than connected ones. With few and noisy views, a broad isolated Gaussian
/// explains noise of several views at once. All Gaussians are kept where none are connected.
pub fn vessels(rows: &[Gaussian], setup: &GaussianSetup, link: f64) -> Vec<bool> {
    let sizes = group_sizes(rows, link);
    let grouped = sizes.iter().map(|size| *size >= MIN_OF_A_VESSEL);
    let breadths: Vec<f32> = rows.iter().map(|g| breadth(g, setup)).collect();
    let of_vessels: Vec<f32> =
        breadths.iter().zip(grouped.clone()).filter(|(_, grouped)| *grouped).map(|b| *b.0).collect();
    if of_vessels.is_empty() {
        return vec![true; rows.len()];
    }
    let broadest = BROADER as f32 * percentile(&of_vessels, BROAD_PERCENTILE);
    breadths.iter().zip(grouped).map(|(breadth, grouped)| grouped || *breadth <= broadest).collect()
}

/// Returns the middle one of a Gaussian's three scales, pixels; the maximum may lie along a vessel.
pub fn breadth(g: &Gaussian, setup: &GaussianSetup) -> f32 {
    let scales = scales(g, setup);
    (scales.element_sum() - scales.max_element() - scales.min_element()) as f32
}

/// Returns for each Gaussian the number of connected Gaussians of its phase, itself included.
fn group_sizes(rows: &[Gaussian], link: f64) -> Vec<usize> {
    let mut left = Cells::new(rows, link);
    let mut sizes = vec![0; rows.len()];
    for first in 0..rows.len() {
        if sizes[first] > 0 {
            continue;
        }
        let mut group = left.take_near(first);
        let mut looked_at = 0;
        while looked_at < group.len() {
            group.extend(left.take_near(group[looked_at]));
            looked_at += 1;
        }
        group.iter().for_each(|i| sizes[*i] = group.len());
    }
    sizes
}

/// Phase and position of a cube.
type Cell = (u32, IVec3);

/// Gaussians that belong to no group yet, sorted into cubes whose side is the maximum distance of neighbours.
struct Cells<'a> {
    rows: &'a [Gaussian],
    link: f64,
    left: HashMap<Cell, Vec<usize>>,
}

impl Cells<'_> {
    fn new(rows: &[Gaussian], link: f64) -> Cells<'_> {
        let mut cells = Cells { rows, link, left: HashMap::new() };
        for i in 0..rows.len() {
            cells.left.entry(cells.cell(i)).or_default().push(i);
        }
        cells
    }

    fn position(&self, i: usize) -> DVec3 {
        DVec3::from_array(self.rows[i].position.map(f64::from))
    }

    fn cell(&self, i: usize) -> Cell {
        (self.rows[i].phase, (self.position(i) / self.link).floor().as_ivec3())
    }

    /// Removes and returns the Gaussians within `link` of a Gaussian, including itself if it is still there.
    fn take_near(&mut self, i: usize) -> Vec<usize> {
        let (phase, middle) = self.cell(i);
        let (at, rows, reach) = (self.position(i), self.rows, self.link * self.link);
        let near = |j: &usize| DVec3::from_array(rows[*j].position.map(f64::from)).distance_squared(at) <= reach;
        let mut taken = Vec::new();
        for (x, y, z) in (-1..=1).flat_map(|z| (-1..=1).flat_map(move |y| (-1..=1).map(move |x| (x, y, z)))) {
            let Some(left) = self.left.get_mut(&(phase, middle + IVec3::new(x, y, z))) else { continue };
            taken.extend(left.extract_if(.., |j| near(j)));
        }
        taken
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SETUP: fn() -> GaussianSetup =
        || GaussianSetup { min_scale: 0.4, max_scale: 6.0, ..GaussianSetup::default() };

    fn at(x: f32, phase: u32, scales: [f32; 3]) -> Gaussian {
        Gaussian { position: [x, 0.0, 0.0], phase, log_scale: scales.map(f32::ln), ..Gaussian::default() }
    }

    #[test]
    fn what_is_alone_and_broad_is_no_vessel() {
        let mut rows: Vec<Gaussian> = (0..20).map(|i| at(3.0 * i as f32, 0, [0.5, 1.0, 4.0])).collect();
        rows.push(at(90.0, 0, [3.0; 3]));
        rows.push(at(-90.0, 0, [0.5, 1.0, 5.0]));
        rows.push(at(30.0, 1, [3.0; 3]));
        rows.push(at(31.0, 0, [3.0; 3]));
        let mut expected = vec![true; 20];
        expected.extend([false, true, false, true]);
        assert_eq!(vessels(&rows, &SETUP(), 4.0), expected, "broad; narrow; of another phase; broad in a vessel");
    }

    #[test]
    fn groups_are_chains_of_neighbours() {
        let xs = [0.0, 3.9, 7.8, 12.0, 30.0];
        let rows: Vec<Gaussian> = xs.iter().map(|x| at(*x, 0, [1.0; 3])).collect();
        assert_eq!(group_sizes(&rows, 4.0), [3, 3, 3, 1, 1]);
        assert_eq!(vessels(&rows, &SETUP(), 4.0), [true; 5], "nothing is a vessel to compare with");
        assert_eq!(vessels(&[], &SETUP(), 4.0), [false; 0]);
    }
}
