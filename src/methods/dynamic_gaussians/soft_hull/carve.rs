//! Combines the views' evidence at pixels into evidence at cells: sums over views, and support from the neighbouring phases.

use crate::evidence::ratios::{LEAST, MOST, ViewEvidence};
use crate::evidence::series::Series;
use crate::fields::carve::Projector;
use crate::geometry::ViewRays;
use crate::model::hull::Hull;
use crate::scan::dataset::Dataset;
use glam::DVec3;
use rayon::prelude::*;

// Numbers of this file without another source: chosen by the share of the vessels' cells that the soft hull keeps, on a procedural
// phantom and one real anatomy with several levels of noise.
/// Weight of the best neighbour at the phase before, and of the one after.
const SUPPORT: f32 = 0.25;
/// Minimum evidence (natural logarithm) of a kept cell that four views or more see; the largest possible is 18 with four.
const KEEP_FOUR_VIEWS: f32 = 9.5;
/// Minimum evidence (natural logarithm) per view of a kept cell that fewer views see; the largest possible is 4.5.
const KEEP_PER_VIEW: f32 = 7.0 / 3.0;
/// Number of phases of a beat from which a vessel moves no further than to a neighbouring coarse cell from one phase to the next.
/// With fewer, a vessel that is not there at the phase before or after is no evidence against it.
const TRACEABLE_PHASES: usize = 4;
/// Lower limit of the neighbours' evidence, in units of a single view's strongest evidence against a cell.
const MIN_SUPPORT: f32 = 2.5;

/// Number of pixels of all images up to which views are analysed beside each other: an analysis takes several times the memory of its images.
const MAX_VALUES_AT_ONCE: usize = 1 << 23;

/// A cell that may hold a moving vessel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HullCell {
    /// Position on the grid, x fastest.
    pub index: u32,
    /// Evidence of all views and of the neighbouring phases for it: a log-likelihood ratio.
    pub evidence: f32,
}

/// Cells that may hold a moving vessel, per phase, on a regular grid in world units.
#[derive(Debug, Clone, PartialEq)]
pub struct SoftHull {
    /// Cells along each axis.
    pub resolution: usize,
    /// Lower corner.
    pub min: DVec3,
    /// Side of a cell.
    pub cell: f64,
    /// Kept cells of each phase, by ascending index.
    pub cells: Vec<Vec<HullCell>>,
}

/// The evidence of every training view with at least two phases, and the hull carved by it.
#[derive(Debug, Clone)]
pub struct SoftMotion {
    /// Evidence of the views, on the dataset's canvas.
    pub views: Vec<ViewEvidence>,
    /// Cells that remain.
    pub hull: SoftHull,
}

impl SoftMotion {
    /// Analyses the training views and carves a cube of half side `half` (world units) into `resolution` (even) cells
    /// along each axis.
    pub fn new(dataset: &Dataset, half: f64, resolution: usize) -> SoftMotion {
        let evidence = |view| ViewEvidence::of(Series::of_view(dataset, view)).on_canvas(dataset.canvas());
        let views = Series::views(dataset);
        let is_large = views.len() * dataset.n_phases as usize * dataset.n_pixels() > MAX_VALUES_AT_ONCE;
        let views: Vec<ViewEvidence> = match is_large {
            true => views.into_iter().map(evidence).collect(),
            false => views.into_par_iter().map(evidence).collect(),
        };
        let mut motion = SoftMotion::uncarved(views);
        motion.carve(dataset, half, resolution);
        motion
    }

    /// Takes evidence that is known already, with a hull that has no cells until [`SoftMotion::carve`].
    pub fn uncarved(views: Vec<ViewEvidence>) -> SoftMotion {
        let hull = SoftHull { resolution: 0, min: DVec3::ZERO, cell: 0.0, cells: Vec::new() };
        SoftMotion { views, hull }
    }

    /// Carves the hull anew, by the evidence and the geometry of a dataset.
    pub fn carve(&mut self, dataset: &Dataset, half: f64, resolution: usize) {
        self.hull = SoftHull::carve(dataset, &self.views, half, resolution.next_multiple_of(2));
    }
}

/// Evidence below which a cell is dropped, seen by so many views.
fn threshold(n_views: usize) -> f32 {
    KEEP_FOUR_VIEWS.min(KEEP_PER_VIEW * n_views as f32)
}

/// Pixels of the views under points, and the sums of their evidence.
struct Votes<'a> {
    /// Projectors of each view, or of each view at each phase where the heart's displacement differs from frame to frame.
    projectors: Vec<Vec<Projector<'a>>>,
    views: &'a [ViewEvidence],
    /// Largest ratio of each pixel over the phases, per view.
    largest: Vec<Vec<f32>>,
    /// Views that must see a point.
    needed: usize,
}

impl<'a> Votes<'a> {
    fn new(dataset: &'a Dataset, views: &'a [ViewEvidence]) -> Votes<'a> {
        let projectors = |v: &ViewEvidence| -> Vec<Projector> {
            let projector = |rays: &ViewRays| Projector::new(dataset, v.view, rays);
            if !dataset.heart_shifts() {
                return vec![projector(&dataset.views[v.view].rays)];
            }
            (0..dataset.n_phases).map(|phase| projector(&dataset.heart_rays_at(v.view, phase))).collect()
        };
        let largest = |v: &ViewEvidence| {
            let mut max = vec![LEAST; dataset.n_pixels()];
            for ratio in v.ratios.iter().flatten() {
                max.iter_mut().zip(&ratio.values).for_each(|(m, v)| *m = m.max(*v));
            }
            max
        };
        Votes {
            projectors: views.iter().map(projectors).collect(),
            views,
            largest: views.iter().map(largest).collect(),
            needed: views.len().min(2),
        }
    }

    /// Number of views that have the phase.
    fn n_at(&self, phase: usize) -> usize {
        self.views.iter().filter(|v| v.ratios[phase].is_some()).count()
    }

    /// Tells whether the pixels of a point differ from phase to phase.
    fn moves(&self) -> bool {
        self.projectors.iter().any(|of_view| of_view.len() > 1)
    }

    fn pixels(&self, point: DVec3, phase: usize, pixels: &mut [Option<usize>]) {
        for (pixel, of_view) in pixels.iter_mut().zip(&self.projectors) {
            *pixel = projector_at(of_view, phase).pixel(point);
        }
    }

    /// Sum of the ratios at a phase over the views that see a point then; `None` where too few do, and where the views looked at so far
    /// show that the sum cannot reach `least`: most points are settled by one or two views.
    fn reaching(&self, point: DVec3, phase: usize, least: f32) -> Option<f32> {
        let (mut sum, mut count, mut remaining) = (0.0, 0, self.n_at(phase));
        for (view, of_view) in self.views.iter().zip(&self.projectors) {
            let Some(ratio) = &view.ratios[phase] else { continue };
            if sum + MOST * (remaining as f32) < least {
                return None;
            }
            remaining -= 1;
            if let Some(pixel) = projector_at(of_view, phase).pixel(point) {
                sum += ratio.values[pixel];
                count += 1;
            }
        }
        (count >= self.needed).then_some(sum)
    }

    /// Sum of the ratios at a phase over the views that see the point then; `None` where too few do.
    fn at(&self, phase: usize, pixels: &[Option<usize>]) -> Option<f32> {
        let seen = self.views.iter().zip(pixels).filter_map(|(v, p)| Some(v.ratios[phase].as_ref()?.values[(*p)?]));
        let (sum, count) = seen.fold((0.0, 0), |(sum, count), ratio| (sum + ratio, count + 1));
        (count >= self.needed).then_some(sum)
    }

    /// Upper bound of the sums of all phases.
    fn at_most(&self, pixels: &[Option<usize>]) -> Option<f32> {
        let seen = self.largest.iter().zip(pixels).filter_map(|(max, p)| Some(max[(*p)?]));
        let (sum, count) = seen.fold((0.0, 0), |(sum, count), ratio| (sum + ratio, count + 1));
        // A view without the phase adds 0, which may exceed its evidence against the cell at other phases.
        (count >= self.needed).then_some(sum.max(0.0))
    }
}

/// Returns the projector of a view at a phase.
fn projector_at<'a>(of_view: &'a [Projector<'a>], phase: usize) -> &'a Projector<'a> {
    &of_view[if of_view.len() > 1 { phase } else { 0 }]
}

fn centre(min: DVec3, cell: f64, n: usize, index: usize) -> DVec3 {
    let at = DVec3::new((index % n) as f64, (index / n % n) as f64, (index / (n * n)) as f64);
    min + (at + 0.5) * cell
}

/// Evidence of the neighbours at the previous and the next phase for each cell of a grid of `n` cells a side, per phase: a
/// vessel moves at most a coarse cell per phase where a beat has enough of them.
fn support(votes: &Votes<'_>, min: DVec3, cell: f64, n: usize, n_phases: usize) -> Vec<Vec<f32>> {
    let least = MIN_SUPPORT * LEAST;
    let mut sums = vec![vec![least; n * n * n]; n_phases];
    let moves = votes.moves();
    let slabs: Vec<Vec<f32>> = (0..n)
        .into_par_iter()
        .map(|z| {
            let mut slab = vec![least; n_phases * n * n];
            let mut pixels = vec![None; votes.views.len()];
            for at in 0..n * n {
                let point = centre(min, cell, n, z * n * n + at);
                for phase in 0..n_phases {
                    if phase == 0 || moves {
                        votes.pixels(point, phase, &mut pixels);
                    }
                    slab[phase * n * n + at] = votes.at(phase, &pixels).unwrap_or(least).max(least);
                }
            }
            slab
        })
        .collect();
    for (phase, sums) in sums.iter_mut().enumerate() {
        for (z, slab) in slabs.iter().enumerate() {
            sums[z * n * n..][..n * n].copy_from_slice(&slab[phase * n * n..][..n * n]);
        }
    }
    let best: Vec<Vec<f32>> = sums.par_iter().map(|sums| largest_neighbour(sums, n)).collect();
    // The phases cover a whole beat, so the last is next to the first.
    (0..n_phases)
        .into_par_iter()
        .map(|t| {
            let (before, after) = (&best[(t + n_phases - 1) % n_phases], &best[(t + 1) % n_phases]);
            before.iter().zip(after).map(|(a, b)| from_neighbours(*a, *b, n_phases)).collect()
        })
        .collect()
}

/// Evidence of the neighbours at the phase before and at the one after, of a beat with so many phases.
fn from_neighbours(before: f32, after: f32, n_phases: usize) -> f32 {
    match n_phases {
        0 | 1 => 0.0,
        // Both neighbours are the same images, which count once.
        2 => SUPPORT * before.max(0.0),
        n if n < TRACEABLE_PHASES => SUPPORT * (before.max(0.0) + after.max(0.0)),
        _ => SUPPORT * (before + after),
    }
}

/// Largest value of the 3 x 3 x 3 cells around each, axis by axis.
fn largest_neighbour(values: &[f32], n: usize) -> Vec<f32> {
    let mut out = values.to_vec();
    for stride in [1, n, n * n] {
        let source = out.clone();
        for (i, value) in out.iter_mut().enumerate() {
            let along = i / stride % n;
            if along > 0 {
                *value = value.max(source[i - stride]);
            }
            if along + 1 < n {
                *value = value.max(source[i + stride]);
            }
        }
    }
    out
}

impl SoftHull {
    /// Carves a cube of half side `half` (world units) into `resolution` (even) cells a side. A cell stays at a phase when the
    /// summed evidence of the views that see it, and the support of its neighbours at the adjacent phases, reach a threshold:
    /// no single view can veto it.
    pub fn carve(dataset: &Dataset, views: &[ViewEvidence], half: f64, resolution: usize) -> SoftHull {
        let n = resolution;
        let cell = 2.0 * half / n as f64;
        let min = DVec3::splat(-half);
        let n_phases = dataset.n_phases as usize;
        let empty = SoftHull { resolution: n, min, cell, cells: vec![Vec::new(); n_phases] };
        if views.is_empty() {
            return empty;
        }
        let votes = Votes::new(dataset, views);
        let coarse = n / 2;
        let support = support(&votes, min, 2.0 * cell, coarse, n_phases);
        let mut max_support = vec![f32::MIN; coarse.pow(3)];
        for phase in &support {
            max_support.iter_mut().zip(phase).for_each(|(max, v)| *max = max.max(*v));
        }
        let thresholds: Vec<f32> = (0..n_phases).map(|phase| threshold(votes.n_at(phase))).collect();
        let least = thresholds.iter().copied().fold(f32::MAX, f32::min);
        let moves = votes.moves();
        let slabs: Vec<Vec<Vec<HullCell>>> = (0..n)
            .into_par_iter()
            .map(|z| {
                let mut kept = vec![Vec::new(); n_phases];
                let mut pixels = vec![None; views.len()];
                for at in 0..n * n {
                    let index = z * n * n + at;
                    let beside = ((z / 2) * coarse + at / n / 2) * coarse + at % n / 2;
                    // The evidence of a view never exceeds MOST: many cells are settled without looking at a pixel.
                    if MOST * views.len() as f32 + max_support[beside] < least {
                        continue;
                    }
                    let point = centre(min, cell, n, index);
                    if !moves {
                        votes.pixels(point, 0, &mut pixels);
                        let largest = votes.at_most(&pixels);
                        if largest.is_none_or(|max| max + max_support[beside] < least) {
                            continue;
                        }
                    }
                    for (phase, kept) in kept.iter_mut().enumerate() {
                        let support = support[phase][beside];
                        let sum = match moves {
                            true => votes.reaching(point, phase, thresholds[phase] - support),
                            false => votes.at(phase, &pixels),
                        };
                        let Some(sum) = sum else { continue };
                        let evidence = sum + support;
                        if evidence >= thresholds[phase] {
                            kept.push(HullCell { index: index as u32, evidence });
                        }
                    }
                }
                kept
            })
            .collect();
        let mut hull = empty;
        for slab in slabs {
            hull.cells.iter_mut().zip(slab).for_each(|(all, kept)| all.extend(kept));
        }
        hull
    }

    /// Centre of a cell, world units.
    pub fn centre(&self, index: u32) -> DVec3 {
        centre(self.min, self.cell, self.resolution, index as usize)
    }

    /// Kept share of all cells, averaged over phases.
    pub fn share(&self) -> f64 {
        let kept: usize = self.cells.iter().map(Vec::len).sum();
        kept as f64 / (self.resolution.pow(3) * self.cells.len().max(1)) as f64
    }

    /// Returns the hull's cells as bits, which training masks samples with, and which are drawn and exported.
    pub fn to_hull(&self) -> Hull {
        let n = self.resolution;
        let words = n.pow(3).div_ceil(32);
        let mut bits = vec![0u32; words * self.cells.len()];
        for (cells, bits) in self.cells.iter().zip(bits.chunks_mut(words)) {
            for cell in cells {
                bits[cell.index as usize / 32] |= 1 << (cell.index % 32);
            }
        }
        Hull { size: [n; 3], min: self.min, cell: self.cell, n_phases: self.cells.len(), bits }
    }
}
