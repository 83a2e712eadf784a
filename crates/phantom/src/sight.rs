//! Position and size of an object against the views: refuses what no image would show, and tells which part is missing.

use crate::error::{Error, Result};
use crate::formats::volume::Volume;
use crate::geometry::{CArm, Geometry, MM_PER_UNIT, world_from_lps_mm};
use crate::projector::{bounding_radius, depth_steps};
use crate::tree::{Bounds, Branch};
use crate::tree_file::{TreeFile, UNITS};
use crate::voxels::grid_size;
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::path::Path;

/// Number of blocks along the longest side of a volume, at most: the voxels of a block are looked at as one point.
const BLOCKS: usize = 128;
/// Distance between the points of a line that are looked at, mm.
const LINE_STEP_MM: f64 = 2.0;
/// Share of an object outside the images of a view from which a warning is given.
const MISSING_SHARE: f64 = 0.01;
/// Largest number of voxels that vessels are drawn into (1 GiB of floats).
const MAX_DRAWN_VOXELS: f64 = (1u64 << 28) as f64;
/// Largest number of steps along a ray through a volume.
const MAX_STEPS: u32 = 1 << 16;

/// Image of a view: a cone from its source.
struct Cone {
    source: DVec3,
    /// Transforms a direction to (column, row, depth) times the depth.
    inverse: DMat3,
    /// Columns and rows.
    size: f64,
    /// Depth behind the source up to which the projector looks, world units.
    reach: f64,
}

impl Cone {
    fn shows(&self, world: DVec3) -> bool {
        let h = self.inverse * (world - self.source);
        let inside = |at: f64| (-0.5..self.size - 0.5).contains(&(at / h.z));
        h.z > 0.0 && h.z < self.reach && inside(h.x) && inside(h.y)
    }
}

/// The training views.
pub(super) struct Sight {
    cones: Vec<Cone>,
    /// Largest field of view at the isocentre, mm.
    field_mm: f64,
    /// Side of a pixel at the isocentre, mm.
    pixel_mm: f64,
    /// Largest distance from a source to the isocentre, mm.
    sod_mm: f64,
}

impl Sight {
    /// Makes the sight of the C-arms of the training views, with images of `size` columns and rows.
    ///
    /// # Errors
    /// [`Error::Config`] for an impossible C-arm.
    pub(super) fn new(c_arms: &[CArm], size: usize) -> Result<Sight> {
        let cone = |c_arm: &CArm| {
            let rays = Geometry::CArm(c_arm.clone()).rays(size, size);
            let rays = rays.map_err(|(field, problem)| Error::config(field, "", problem))?;
            let basis = DMat3::from_cols(rays.direction[1], rays.direction[2], rays.direction[0]);
            Ok(Cone { source: rays.source(), inverse: basis.inverse(), size: size as f64, reach: 2.0 * rays.sod })
        };
        let pixels = c_arms.iter().map(|c| c.pixel_mm[0].max(c.pixel_mm[1]) * c.sod_mm / c.sid_mm);
        let pixel_mm = pixels.fold(0.0, f64::max);
        let cones = c_arms.iter().map(cone).collect::<Result<Vec<Cone>>>()?;
        let sod_mm = c_arms.iter().map(|c| c.sod_mm).fold(0.0, f64::max);
        Ok(Sight { cones, field_mm: pixel_mm * size as f64, pixel_mm, sod_mm })
    }

    fn in_words(&self) -> String {
        format!("the training views look at the isocentre (0, 0, 0) and show {} mm there", mm(self.field_mm))
    }
}

/// A length or position in mm, with as many digits as say something.
fn mm(value: f64) -> String {
    match value.abs() {
        large if large >= 1e5 => format!("{value:.1e}"),
        large if large >= 10.0 => format!("{value:.0}"),
        _ => format!("{value:.2}"),
    }
}

/// Positions that a box covers, in words.
fn position(bounds: &Bounds) -> String {
    let along = |axis: usize| format!("{} to {}", mm(bounds.low_mm[axis]), mm(bounds.high_mm[axis]));
    format!("at {} mm to the left, {} mm to the back and {} mm to the head", along(0), along(1), along(2))
}

/// An object, and how much of it each training view shows.
pub(super) struct Seen<'a> {
    sight: &'a Sight,
    bounds: Bounds,
    total: f64,
    /// Amount in the images of each view.
    shown: Vec<f64>,
}

impl<'a> Seen<'a> {
    /// Returns an empty object.
    pub(super) fn new(sight: &'a Sight) -> Seen<'a> {
        Seen { sight, bounds: Bounds::EMPTY, total: 0.0, shown: vec![0.0; sight.cones.len()] }
    }

    /// Tells whether there is nothing.
    pub(super) fn is_empty(&self) -> bool {
        self.total <= 0.0
    }

    fn add(&mut self, lps_mm: DVec3, amount: f64) {
        let world = world_from_lps_mm(lps_mm);
        self.total += amount;
        for (shown, cone) in self.shown.iter_mut().zip(&self.sight.cones) {
            *shown += if cone.shows(world) { amount } else { 0.0 };
        }
    }

    /// Adds the voxels of a volume, each by its value.
    pub(super) fn add_volume(&mut self, volume: &Volume) {
        let [nx, ny, nz] = volume.size;
        let side = nx.max(ny).max(nz).div_ceil(BLOCKS).max(1);
        let blocks = volume.size.map(|n| n.div_ceil(side));
        let layer = |bz: usize| {
            let mut sums = vec![0f64; blocks[0] * blocks[1]];
            for (z, y) in (bz * side..nz.min((bz + 1) * side)).flat_map(|z| (0..ny).map(move |y| (z, y))) {
                let row = &volume.values[(z * ny + y) * nx..][..nx];
                let of_row = &mut sums[y / side * blocks[0]..][..blocks[0]];
                for (sum, values) in of_row.iter_mut().zip(row.chunks(side)) {
                    *sum += values.iter().map(|v| f64::from(v.abs())).sum::<f64>();
                }
            }
            sums
        };
        let layers: Vec<Vec<f64>> = (0..blocks[2]).into_par_iter().map(layer).collect();
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        for (at, sum) in layers.iter().flatten().enumerate().filter(|(_, sum)| **sum > 0.0) {
            let block = [at % blocks[0], at / blocks[0] % blocks[1], at / (blocks[0] * blocks[1])];
            let first = DVec3::from_array(block.map(|b| (b * side) as f64)) - 0.5;
            let ends = [0, 1, 2].map(|k| ((block[k] + 1) * side).min(volume.size[k]) as f64);
            let last = DVec3::from_array(ends) - 0.5;
            (low, high) = (low.min(first), high.max(last));
            self.add(volume.index_to_lps.transform_point3(0.5 * (first + last)), *sum);
        }
        for corner in (0..8).filter(|_| low.is_finite()) {
            let pick = |axis: usize| if corner >> axis & 1 == 1 { high[axis] } else { low[axis] };
            let corner_mm = volume.index_to_lps.transform_point3(DVec3::from_array([0, 1, 2].map(pick)));
            self.bounds = self.bounds.joined(Bounds { low_mm: corner_mm, high_mm: corner_mm });
        }
    }

    /// Adds the vessels of a tree at each of its stored phases, by their volume.
    pub(super) fn add_tree(&mut self, tree: &TreeFile) {
        self.bounds = self.bounds.joined(tree.bounds());
        tree.stored().flat_map(|tree| tree.branches).for_each(|branch| self.add_branch(&branch));
    }

    fn add_branch(&mut self, branch: &Branch) {
        for (ends, radii) in branch.points.windows(2).zip(branch.radius_mm.windows(2)) {
            let length = ends[0].distance(ends[1]);
            let steps = (length / LINE_STEP_MM).ceil().max(1.0);
            for step in 0..steps as usize {
                let along = (step as f64 + 0.5) / steps;
                let radius = radii[0] + (radii[1] - radii[0]) * along;
                self.add(ends[0].lerp(ends[1], along), radius * radius * length / steps);
            }
        }
    }

    /// Refuses an object that no training view shows; `named` is its name, in the plural.
    ///
    /// # Errors
    /// [`Error::Data`] that says where the object lies and where the views look.
    pub(super) fn check(&self, file: &Path, named: &str) -> Result<()> {
        if self.is_empty() {
            let problem = format!("{named} are empty: nothing attenuates X-rays at any phase");
            return Err(Error::data(file, "values", problem));
        }
        if self.shown.iter().any(|shown| *shown > 0.0) {
            return Ok(());
        }
        let problem = format!(
            "no training view shows any part of {named}: they lie {}, and {}. --centre puts their middle at the \
             isocentre",
            position(&self.bounds),
            self.sight.in_words()
        );
        Err(Error::data(file, "position", problem))
    }

    /// Returns a warning that names the views in whose images part of the object is missing.
    pub(super) fn missing(&self, named: &str) -> Option<String> {
        let share = |shown: &f64| shown / self.total.max(f64::MIN_POSITIVE);
        let views = self.shown.iter().map(share).enumerate().filter(|(_, share)| 1.0 - share > MISSING_SHARE);
        let views: Vec<String> =
            views.map(|(view, share)| format!("view {view} shows {:.0} %", 100.0 * share)).collect();
        (!views.is_empty()).then(|| {
            format!(
                "the images show only part of {named}: {} (they lie {}, and {})",
                views.join(", "),
                position(&self.bounds),
                self.sight.in_words()
            )
        })
    }
}

/// Refuses a tree whose lengths cannot be millimetres, before voxels are reserved for it.
///
/// # Errors
/// [`Error::Data`] naming the length.
pub(super) fn check_lengths(file: &Path, tree: &TreeFile, sight: &Sight, voxel_mm: f64) -> Result<()> {
    let (index, widest) = tree.widest_mm();
    if 2.0 * widest > sight.field_mm {
        let problem = format!(
            "is {} mm, so the vessel is wider than the field of view ({} mm at the isocentre): {UNITS}",
            mm(widest),
            mm(sight.field_mm)
        );
        return Err(Error::data(file, format!("radius_mm[{index}]"), problem));
    }
    let bounds = tree.bounds();
    let extent = bounds.high_mm - bounds.low_mm;
    let voxels: f64 = grid_size(bounds, voxel_mm).iter().map(|n| *n as f64).product();
    let beyond = extent.max_element() > 2.0 * sight.sod_mm;
    if voxels.is_nan() || voxels > MAX_DRAWN_VOXELS || beyond {
        let problem = format!(
            "the vessels extend over {} x {} x {} mm, which is too much for the views and for voxels of {voxel_mm} mm; they lie {}, \
             and {}. Check the largest coordinates: {UNITS}",
            mm(extent.x),
            mm(extent.y),
            mm(extent.z),
            position(&bounds),
            sight.in_words()
        );
        return Err(Error::data(file, "points_mm", problem));
    }
    if extent.max_element() < sight.pixel_mm {
        let problem = format!(
            "the whole tree is {} mm long, less than a pixel ({} mm at the isocentre): {UNITS}",
            mm(extent.max_element()),
            mm(sight.pixel_mm)
        );
        return Err(Error::data(file, "points_mm", problem));
    }
    Ok(())
}

/// Refuses a volume whose voxels are too small, or of no size at all, to be looked through.
///
/// # Errors
/// [`Error::Data`] naming the spacing.
pub(super) fn check_spacing(file: &Path, volume: &Volume, sight: &Sight) -> Result<()> {
    let (spacing, volume_of_voxel) = (volume.spacing_mm(), volume.index_to_lps.matrix3.determinant().abs());
    let placed = volume.index_to_lps.translation.is_finite() && volume_of_voxel.is_finite();
    if !placed || volume_of_voxel <= 0.0 || spacing <= 0.0 {
        let problem = "the directions of the axes do not span a space, or the spacing or the position is not a number";
        return Err(Error::data(file, "spacing", problem));
    }
    let half = bounding_radius(volume).min(sight.sod_mm / MM_PER_UNIT);
    if depth_steps(volume, half) > MAX_STEPS {
        let problem = format!(
            "is {spacing:.1e} mm, too small for rays that are {} mm long in the volume: lengths are mm. Resample the volume, \
             or put it at the isocentre (--centre)",
            mm(2.0 * half * MM_PER_UNIT)
        );
        return Err(Error::data(file, "spacing", problem));
    }
    Ok(())
}
