//! Sampling of the dynamic field where it is not faint: at coarse points everywhere, and in blocks of a finer grid where
//! needed.

use crate::error::Result;
use crate::export::volumes::grid_over;
use crate::geometry::MM_PER_UNIT;
use crate::model::component::Component;
use crate::model::scene::Scene;
use crate::render::grid::PatientGrid;
use crate::render::renderer::Renderer;
use glam::DVec3;
use std::collections::BTreeSet;

/// Step of the coarse points, pixels. With a step of one pixel, the share of the mass far from vessels is off by up to 0.06.
const COARSE_PIXELS: f64 = 0.75;
/// Maximum number of coarse points along the longest side.
const COARSE_POINTS: f64 = 192.0;
/// Share of the threshold below which a coarse point is faint, and nothing around it is vessel: a Gaussian of 0.4 pixels,
/// the minimum, keeps this share of its peak at the largest possible distance from such points.
const FAINT: f64 = 0.25;
/// Voxels of a block that is sampled at once, along left, posterior (a workgroup of the device) and superior.
const BLOCK: [u32; 3] = [8, 64, 8];
/// Voxels along each side of the cubes that make up a block, for which bounds are computed.
const CUBE: u32 = 8;

/// The first and the last point of a box, patient mm.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Corners {
    pub(crate) low_mm: DVec3,
    pub(crate) high_mm: DVec3,
}

impl Corners {
    /// Corners of a grid's points.
    pub(crate) fn of(grid: &PatientGrid) -> Corners {
        let steps = DVec3::from_array(grid.size.map(|n| f64::from(n) - 1.0));
        Corners { low_mm: grid.origin_mm, high_mm: grid.origin_mm + steps * grid.spacing_mm }
    }

    /// A box around a point.
    pub(crate) fn around(point_mm: DVec3, reach_mm: f64) -> Corners {
        Corners { low_mm: point_mm, high_mm: point_mm }.grown(reach_mm)
    }

    pub(crate) fn grown(self, by_mm: f64) -> Corners {
        Corners { low_mm: self.low_mm - by_mm, high_mm: self.high_mm + by_mm }
    }

    pub(crate) fn joined(self, other: Corners) -> Corners {
        Corners { low_mm: self.low_mm.min(other.low_mm), high_mm: self.high_mm.max(other.high_mm) }
    }
}

/// The dynamic field at a phase.
pub(crate) struct VesselField<'a> {
    pub(crate) renderer: &'a Renderer,
    pub(crate) scene: &'a Scene,
    pub(crate) phase: u32,
    pub(crate) pixel_mm: f64,
    /// Threshold above which the field is vessel.
    pub(crate) threshold_per_mm: f64,
}

impl VesselField<'_> {
    /// Samples the whole field at points [`COARSE_PIXELS`] apart, or further for large fields.
    pub(crate) fn coarse(&self) -> Result<CoarseField> {
        let [low, high] = self.scene.region_of(Component::Dynamic).map(DVec3::from_array);
        let longest_mm = (high - low).max_element() * MM_PER_UNIT;
        let spacing_mm = (COARSE_PIXELS * self.pixel_mm).max(longest_mm / COARSE_POINTS);
        let grid = grid_over(self.scene, Component::Dynamic, spacing_mm)?;
        Ok(CoarseField { grid, values: self.renderer.sample_patient(Component::Dynamic, self.phase, &grid)? })
    }

    /// Boxes that contain all points that are not faint.
    pub(crate) fn boxes(&self, coarse: &CoarseField) -> Vec<Corners> {
        coarse.boxes(FAINT * self.threshold_per_mm).collect()
    }

    /// Passes the field at the points of a grid inside boxes to `put`, per mm: one row along left at a time, with the index
    /// of its first point. The field is not evaluated elsewhere.
    pub(crate) fn rows(&self, boxes: &[Corners], grid: &PatientGrid, put: impl FnMut(usize, &[f32])) -> Result<()> {
        self.sample(blocks(boxes, grid), grid, put)
    }

    /// Marks the points of a grid at which the field is vessel. Blocks that are entirely inside or outside by the
    /// Gaussians' bounds are not sampled; for other fields, blocks that are faint at the coarse points around are not.
    pub(crate) fn vessels(&self, coarse: &CoarseField, grid: &PatientGrid) -> Result<Vec<bool>> {
        let mut inside = vec![false; grid.size.iter().map(|n| *n as usize).product()];
        let blocks = match self.renderer.bound_patient(self.phase, &cubes(grid), cube_reach_mm(grid))? {
            Some(bounds) => self.undecided(grid, bounds, &mut inside),
            None => blocks(&self.boxes(coarse), grid),
        };
        self.sample(blocks, grid, |first, values| {
            let inside = inside[first..].iter_mut().zip(values);
            inside.for_each(|(inside, value)| *inside = f64::from(*value) > self.threshold_per_mm);
        })?;
        Ok(inside)
    }

    /// Returns the blocks that the bounds of cubes leave undecided, and marks those that are entirely vessel.
    fn undecided(&self, grid: &PatientGrid, [min, max]: [Vec<f32>; 2], inside: &mut [bool]) -> Vec<Block> {
        let above = |bounds: Vec<f32>| bounds.into_iter().map(|v| f64::from(v) > self.threshold_per_mm).collect();
        let (surely, maybe): (Vec<bool>, Vec<bool>) = (above(min), above(max));
        let [nx, ny, _] = cubes(grid).size.map(|n| n as usize);
        let mut undecided = Vec::new();
        for place in all_blocks(grid) {
            let block = block_at(place, grid);
            let [x, y, z] = block.first.map(|i| i as usize / CUBE as usize);
            let along_y = block.grid.size[1].div_ceil(CUBE) as usize;
            let cubes: Vec<usize> = (0..along_y).map(|k| (z * ny + y + k) * nx + x).collect();
            if cubes.iter().all(|cube| surely[*cube]) {
                fill(inside, grid, &block);
            } else if cubes.iter().any(|cube| maybe[*cube]) {
                undecided.push(block);
            }
        }
        undecided
    }

    /// Passes the field at the points of a grid inside blocks to `put`, as [`VesselField::rows`] does.
    fn sample(&self, blocks: Vec<Block>, grid: &PatientGrid, mut put: impl FnMut(usize, &[f32])) -> Result<()> {
        let [nx, ny, _] = grid.size.map(|n| n as usize);
        for block in blocks {
            let [x, y, z] = block.first.map(|i| i as usize);
            let [columns, rows, _] = block.grid.size.map(|n| n as usize);
            let values = self.renderer.sample_patient(Component::Dynamic, self.phase, &block.grid)?;
            for (row, values) in values.chunks(columns).enumerate() {
                put(((z + row / rows) * ny + y + row % rows) * nx + x, values);
            }
        }
        Ok(())
    }
}

/// Part of a grid.
struct Block {
    /// Index of its first point in the whole grid.
    first: [u32; 3],
    grid: PatientGrid,
}

/// The field at coarse points.
pub(crate) struct CoarseField {
    pub(crate) grid: PatientGrid,
    pub(crate) values: Vec<f32>,
}

impl CoarseField {
    /// Points with positive attenuation, patient mm, and the attenuation, per mm.
    pub(crate) fn points(&self) -> impl Iterator<Item = (DVec3, f64)> {
        let [nx, ny, _] = self.grid.size.map(|n| n as usize);
        let attenuating = self.values.iter().enumerate().filter(|(_, value)| **value > 0.0);
        attenuating.map(move |(i, value)| {
            let index = DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / (nx * ny)) as f64);
            (self.grid.origin_mm + index * self.grid.spacing_mm, f64::from(*value))
        })
    }

    /// Boxes around the points above a threshold, each with all that is closer to its point than the next point.
    fn boxes(&self, threshold_per_mm: f64) -> impl Iterator<Item = Corners> {
        let around_mm = self.grid.spacing_mm.max_element();
        let above = self.points().filter(move |(_, value)| *value > threshold_per_mm);
        above.map(move |(point, _)| Corners::around(point, around_mm))
    }

    /// Box that contains everything above a threshold.
    pub(crate) fn reach(&self, threshold_per_mm: f64) -> Option<Corners> {
        self.boxes(threshold_per_mm).reduce(Corners::joined)
    }
}

/// Centres of the cubes of a grid.
fn cubes(grid: &PatientGrid) -> PatientGrid {
    let to_middle = 0.5 * (f64::from(CUBE) - 1.0);
    PatientGrid {
        origin_mm: grid.origin_mm + to_middle * grid.spacing_mm,
        spacing_mm: f64::from(CUBE) * grid.spacing_mm,
        size: grid.size.map(|n| n.div_ceil(CUBE)),
    }
}

/// Distance of the corners of a cube from its centre, slightly enlarged for rounding, mm.
fn cube_reach_mm(grid: &PatientGrid) -> f64 {
    0.5 * f64::from(CUBE) * grid.spacing_mm.length()
}

/// Marks the points of a block.
fn fill(inside: &mut [bool], grid: &PatientGrid, block: &Block) {
    let [nx, ny, _] = grid.size.map(|n| n as usize);
    let [x, y, z] = block.first.map(|i| i as usize);
    let [columns, rows, slices] = block.grid.size.map(|n| n as usize);
    for row in 0..rows * slices {
        inside[((z + row / rows) * ny + y + row % rows) * nx + x..][..columns].fill(true);
    }
}

/// Indices of all blocks of a grid.
fn all_blocks(grid: &PatientGrid) -> impl Iterator<Item = [u32; 3]> {
    let [nx, ny, nz]: [u32; 3] = std::array::from_fn(|axis| grid.size[axis].div_ceil(BLOCK[axis]));
    (0..nz).flat_map(move |z| (0..ny).flat_map(move |y| (0..nx).map(move |x| [z, y, x])))
}

/// Returns the block at an index along superior, posterior and left.
fn block_at([z, y, x]: [u32; 3], grid: &PatientGrid) -> Block {
    let first = [x * BLOCK[0], y * BLOCK[1], z * BLOCK[2]];
    let steps = DVec3::from_array(first.map(f64::from));
    let size = std::array::from_fn(|axis| BLOCK[axis].min(grid.size[axis] - first[axis]));
    Block { first, grid: PatientGrid { origin_mm: grid.origin_mm + steps * grid.spacing_mm, size, ..*grid } }
}

/// Blocks of a grid that overlap boxes.
fn blocks(boxes: &[Corners], grid: &PatientGrid) -> Vec<Block> {
    let in_blocks = |point_mm: DVec3| {
        let voxel = (point_mm - grid.origin_mm) / grid.spacing_mm;
        let last = DVec3::from_array(grid.size.map(|n| f64::from(n - 1)));
        let voxel = voxel.clamp(DVec3::ZERO, last).as_uvec3().to_array();
        [voxel[0] / BLOCK[0], voxel[1] / BLOCK[1], voxel[2] / BLOCK[2]]
    };
    let mut wanted = BTreeSet::new();
    for Corners { low_mm, high_mm } in boxes {
        let (low, high) = (in_blocks(*low_mm), in_blocks(*high_mm));
        for z in low[2]..=high[2] {
            for y in low[1]..=high[1] {
                wanted.extend((low[0]..=high[0]).map(|x| [z, y, x]));
            }
        }
    }
    wanted.into_iter().map(|place| block_at(place, grid)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_points_tell_where_to_look() {
        let coarse = PatientGrid { origin_mm: DVec3::splat(-2.0), spacing_mm: DVec3::splat(2.0), size: [3, 3, 3] };
        let mut coarse = CoarseField { grid: coarse, values: vec![0.0; 27] };
        coarse.values[13] = 5.0;
        coarse.values[14] = 3.0;
        let reach = coarse.reach(4.0).unwrap();
        assert_eq!((reach.low_mm, reach.high_mm), (DVec3::splat(-2.0), DVec3::splat(2.0)));
        assert_eq!(coarse.reach(1.0).unwrap().high_mm, DVec3::new(4.0, 2.0, 2.0));
        assert!(coarse.reach(6.0).is_none());
        // Voxels have a quarter of a millimetre, from the centre: the box of the centre ends at 2 mm, the other's at 4 mm.
        let grid = PatientGrid { origin_mm: DVec3::ZERO, spacing_mm: DVec3::splat(0.25), size: [20, 70, 20] };
        let blocks = |threshold| {
            let boxes: Vec<Corners> = coarse.boxes(threshold).collect();
            let blocks = blocks(&boxes, &grid);
            blocks.iter().map(|b| (b.first, b.grid.origin_mm.to_array(), b.grid.size)).collect::<Vec<_>>()
        };
        // A block has 2 mm, 16 mm and 2 mm; the last one of a row is the remainder.
        let of_the_middle = blocks(4.0);
        assert!(
            of_the_middle.contains(&([0; 3], [0.0; 3], [8, 64, 8])) && of_the_middle.len() == 4,
            "{of_the_middle:?}"
        );
        let of_both = blocks(1.0);
        assert!(of_both.contains(&([16, 0, 8], [4.0, 0.0, 2.0], [4, 64, 8])) && of_both.len() == 6, "{of_both:?}");
    }
}
