//! The motion hull: the region in which the dynamic field may exist.

use crate::formats::volume::Volume;
use crate::geometry::{MM_PER_UNIT, ViewRays};
use glam::{DAffine3, DMat3, DVec3};

/// Binary volumes on a regular grid, one for all phases or one per phase; world units, x fastest.
#[derive(Debug, Clone, PartialEq)]
pub struct Hull {
    /// Cells along x, y, z.
    pub size: [usize; 3],
    /// Lower corner.
    pub min: DVec3,
    /// Side of a cell.
    pub cell: f64,
    /// Volumes: 1, or one per phase.
    pub n_phases: usize,
    /// 32 cells to a word, lowest bit first; each phase starts a new word.
    pub bits: Vec<u32>,
}

impl Hull {
    /// Returns the number of words of one phase's volume.
    pub fn words(&self) -> usize {
        self.bits.len() / self.n_phases
    }

    /// Returns the hull as a volume for display: the number of phases at which each cell is kept.
    pub fn to_volume(&self) -> Volume {
        let cell_mm = self.cell * MM_PER_UNIT;
        // Index axes follow the world's (posterior, left, superior); LPS swaps the first two.
        let axes = DMat3::from_cols(DVec3::Y * cell_mm, DVec3::X * cell_mm, DVec3::Z * cell_mm);
        let first = (self.min + 0.5 * self.cell) * MM_PER_UNIT;
        let count = |i: usize| self.bits.chunks(self.words()).filter(|w| w[i / 32] >> (i % 32) & 1 == 1).count();
        Volume {
            size: self.size,
            values: (0..self.size.iter().product()).map(|i| count(i) as f32).collect(),
            index_to_lps: DAffine3::from_mat3_translation(axes, DVec3::new(first.y, first.x, first.z)),
        }
    }

    /// Tells whether a point lies in a cell kept at a phase.
    pub fn contains_point(&self, point: DVec3, phase: usize) -> bool {
        let c = ((point - self.min) / self.cell).floor();
        let inside = |v: f64, n: usize| v >= 0.0 && v < n as f64;
        if !(inside(c.x, self.size[0]) && inside(c.y, self.size[1]) && inside(c.z, self.size[2])) {
            return false;
        }
        let index = (c.z as usize * self.size[1] + c.y as usize) * self.size[0] + c.x as usize;
        let start = if self.n_phases > 1 { phase * self.words() } else { 0 };
        self.bits[start + index / 32] >> (index % 32) & 1 == 1
    }

    /// Returns the share of kept cells, averaged over phases.
    pub fn share(&self) -> f64 {
        let kept: u64 = self.bits.iter().map(|w| u64::from(w.count_ones())).sum();
        kept as f64 / (self.size.iter().product::<usize>() * self.n_phases) as f64
    }

    /// Returns the lower and upper corner of the cells kept at any phase; `None` when no cell is kept.
    pub fn bounds(&self) -> Option<(DVec3, DVec3)> {
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for corner in (0..self.n_phases).flat_map(|phase| self.corners(phase)) {
            low = low.min(corner);
            high = high.max(corner + self.cell);
        }
        low.is_finite().then_some((low, high))
    }

    /// Returns the lower corners of the cells kept at a phase.
    fn corners(&self, phase: usize) -> impl Iterator<Item = DVec3> {
        let [nx, ny, _] = self.size;
        let corner = move |index: usize| {
            self.min + self.cell * DVec3::new((index % nx) as f64, (index / nx % ny) as f64, (index / (nx * ny)) as f64)
        };
        let start = if self.n_phases > 1 { phase * self.words() } else { 0 };
        let words = self.bits[start..start + self.words()].iter().enumerate().filter(|(_, bits)| **bits != 0);
        words.flat_map(move |(word, bits)| {
            (0..32).filter(move |bit| bits >> bit & 1 == 1).map(move |bit| corner(word * 32 + bit))
        })
    }

    /// Tells for each pixel of a `width` x `height` view, row by row, whether a cell kept at a phase projects onto it, so that
    /// the dynamic field can explain the pixel. A cell covers the square that contains its projection.
    pub fn silhouette(&self, rays: &ViewRays, (width, height): (usize, usize), phase: usize) -> Vec<bool> {
        let mut covered = vec![false; width * height];
        let pixel = rays.direction[1].length().min(rays.direction[2].length()) * rays.sod;
        let reach = 0.5 * 3f64.sqrt() * self.cell / pixel;
        let span = |centre: f64, n: usize| {
            (centre - reach).round().clamp(0.0, n as f64) as usize
                ..((centre + reach).round() + 1.0).clamp(0.0, n as f64) as usize
        };
        for corner in self.corners(phase) {
            let Some((column, row)) = rays.project(corner + 0.5 * self.cell) else { continue };
            for row in span(row, height) {
                covered[row * width..][span(column, width)].fill(true);
            }
        }
        covered
    }
}
