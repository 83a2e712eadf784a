//! The images of a view beside the shadows of a tree in them: blurred line integrals, how certain they are, and the linear map from areas of
//! points to them.

use crate::evidence::background::Background;
use crate::evidence::series::{Series, blur};
use crate::geometry::{MM_PER_UNIT, ViewRays, world_from_lps_mm};
use crate::raster::{Image, median, median_filter};
use crate::scan::dataset::Dataset;
use crate::trees::areas::shadows::{PointShadow, Shadows};
use crate::trees::refine::tangents;
use crate::trees::ridges::ridge_offset;
use crate::trees::tree::{Branch, PhaseTree};
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use std::f64::consts::PI;

// Numbers of this file without another source: developed on five draws of stenoses in five trees; a sixth draw took no part
// (docs/performance.md, Stenoses; docs/tried.md).
/// Standard deviation of the blur of images and shadows, pixels: errors of the places of centrelines matter less in blurred images.
const BLUR_PX: f64 = 0.6;
/// Error of a shadow, as a share of its line integral.
const SHADOW_ERROR: f64 = 0.1;
/// Residual from which a pixel loses weight, in standard deviations (Huber).
const OUTLIER: f64 = 2.5;
/// Largest distance of a centreline from the ridge of its shadow, pixels: a ridge farther away belongs to another vessel.
const FARTHEST_RIDGE_PX: f64 = 1.6;
/// Number of points on each side over which distances from ridges are averaged, and how many of them must have a ridge.
const RIDGE_POINTS: usize = 4;
const MIN_RIDGES: usize = 4;
/// Share of the changes of a pixel from phase to phase that is an error of the shadows there.
const OF_CHANGES: f64 = 0.3;
/// Radius of the median filter of the changes from phase to phase, pixels.
const STEADY_PX: usize = 2;
/// Minimum number of phases that a view must show: its static background is found from their differences.
const MIN_PHASES: usize = 3;

/// An image of a view and the shadows of the tree in it.
pub(super) struct ShadowedFrame {
    /// Index of the phase among those of the tree.
    pub phase: usize,
    shadows: Shadows,
    /// Line integrals, blurred.
    pub image: Vec<f64>,
    weights: Vec<f64>,
}

/// The images of a view.
pub(super) struct ShadowedView {
    /// The images.
    pub frames: Vec<ShadowedFrame>,
    /// Width of a pixel at the isocentre, mm.
    pub pixel_mm: f64,
    /// Variance of each pixel of the blurred images: of its noise, and of a share of its changes from phase to phase.
    variance: Vec<f64>,
    /// Whether each pixel shows the patient.
    shown: Vec<bool>,
}

impl ShadowedView {
    /// Returns the images of a view that show phases of the tree; `None` where there are too few.
    pub fn new(series: Series, dataset: &Dataset, phases: &[PhaseTree], attenuation: f64) -> Option<ShadowedView> {
        let background = Background::new(series);
        let view = background.stilled.view;
        let size = dataset.views[view].size;
        let frame = |(phase, tree): (usize, &PhaseTree)| {
            let image = background.stilled.images.get(tree.phase as usize)?.as_ref()?;
            let change = background.changes.get(tree.phase as usize)?.as_ref()?;
            let projection = Projection {
                rays: dataset.heart_rays_at(view, tree.phase),
                attenuation: attenuation * dataset.contrast_at(view, tree.phase),
                change,
                strongest: background.strongest,
            };
            let image = blur(image, BLUR_PX as f32).values.into_iter().map(f64::from).collect();
            let shadows = projection.shadows(tree, size);
            Some(ShadowedFrame { phase, shadows, image, weights: Vec::new() })
        };
        let frames: Vec<ShadowedFrame> = phases.par_iter().enumerate().filter_map(frame).collect();
        if frames.len() < MIN_PHASES {
            return None;
        }
        let noise =
            background.noise.values.iter().map(|noise| f64::from(*noise).powi(2) / (4.0 * PI * BLUR_PX.powi(2)));
        let variance = noise
            .zip(unsteadiness(&frames, size))
            .map(|(noise, changes)| noise + (OF_CHANGES * changes).powi(2))
            .collect();
        let on_canvas = |p: usize| p / size[0] * dataset.width + p % size[0];
        let shown = (0..size[0] * size[1]).map(|p| dataset.shows(view, on_canvas(p))).collect();
        Some(ShadowedView {
            frames,
            pixel_mm: pixel_mm2(&dataset.views[view].rays, DVec3::ZERO).sqrt(),
            variance,
            shown,
        })
    }

    fn n_pixels(&self) -> usize {
        self.variance.len()
    }

    /// Sets the weights of all pixels for areas, `[phase][point]`: the inverse of their variances, less for outliers and none for hidden
    /// pixels.
    pub fn weigh(&mut self, areas: &[Vec<f64>]) {
        let n = self.n_pixels();
        let models = self.images(areas);
        let residual = |k: usize, p: usize| self.frames[k].image[p] - models[k][p];
        let static_level = |p: usize| {
            let mut values: Vec<f32> = (0..models.len()).map(|k| residual(k, p) as f32).collect();
            f64::from(median(&mut values))
        };
        let levels: Vec<f64> = (0..n).into_par_iter().map(static_level).collect();
        // Neighbours of a blurred image hold the same information.
        let shared = 1.0 + 4.0 * PI * BLUR_PX.powi(2);
        let weight = |k: usize, p: usize| {
            if !self.shown[p] {
                return 0.0;
            }
            let variance = self.variance[p] + (SHADOW_ERROR * models[k][p]).powi(2);
            let away = (residual(k, p) - levels[p]).abs() / variance.sqrt();
            (OUTLIER / away.max(OUTLIER)) / (variance * shared)
        };
        let weights: Vec<Vec<f64>> =
            (0..models.len()).into_par_iter().map(|k| (0..n).map(|p| weight(k, p)).collect()).collect();
        self.frames.iter_mut().zip(weights).for_each(|(frame, weights)| frame.weights = weights);
    }

    /// Returns, for each frame, the sum of an image at each of a number of points, weighted by the pixels' weights and the point's shadow. The
    /// weighted mean of each pixel over the frames is subtracted before: the static background of a pixel is unknown.
    pub fn sums(&self, images: &[Vec<f64>], n_points: usize) -> Vec<Vec<f64>> {
        let mean = |p: usize| {
            let (mut sum, mut weights) = (0.0, 0.0);
            for (frame, image) in self.frames.iter().zip(images) {
                sum += frame.weights[p] * image[p];
                weights += frame.weights[p];
            }
            if weights > 0.0 { sum / weights } else { 0.0 }
        };
        let means: Vec<f64> = (0..self.n_pixels()).into_par_iter().map(mean).collect();
        let of_frame = |(frame, image): (&ShadowedFrame, &Vec<f64>)| {
            let weighted: Vec<f64> =
                image.iter().zip(&means).zip(&frame.weights).map(|((value, mean), w)| w * (value - mean)).collect();
            let mut sums = vec![0.0; n_points];
            frame.shadows.add_sums(&weighted, &mut sums);
            sums
        };
        self.frames.par_iter().zip(images).map(of_frame).collect()
    }

    /// Returns the line integrals of vessels in all frames; `areas` are those of the points at each phase, `[phase][point]`, mm^2.
    pub fn images(&self, areas: &[Vec<f64>]) -> Vec<Vec<f64>> {
        self.frames.par_iter().map(|frame| frame.shadows.image(&areas[frame.phase], self.n_pixels())).collect()
    }
}

/// Returns the standard deviation of each pixel from phase to phase. Where shadows pass, it includes errors of their places.
fn unsteadiness(frames: &[ShadowedFrame], [width, height]: [usize; 2]) -> impl Iterator<Item = f64> {
    // Ratio of a normal distribution's standard deviation to its median absolute value, for differences of two values.
    const MEDIAN_TO_DEVIATION: f32 = 1.4826 / std::f32::consts::SQRT_2;
    let at = |p: usize| {
        let mut steps: Vec<f32> =
            frames.windows(2).map(|pair| (pair[1].image[p] - pair[0].image[p]).abs() as f32).collect();
        MEDIAN_TO_DEVIATION * median(&mut steps)
    };
    let values = (0..width * height).into_par_iter().map(at).collect();
    median_filter(&Image { width, height, values }, STEADY_PX).values.into_iter().map(f64::from)
}

/// Returns the area of a pixel at a point, perpendicular to the ray, mm^2.
fn pixel_mm2(rays: &ViewRays, point_mm: DVec3) -> f64 {
    let away = world_from_lps_mm(point_mm) - rays.source();
    let depth_mm = away.dot(rays.axis()).abs() * MM_PER_UNIT;
    let obliquity = away.normalize_or(rays.axis()).dot(rays.axis()).abs();
    rays.direction[1].cross(rays.direction[2]).length() * depth_mm.powi(2) * obliquity
}

/// An image of a view and how the tree is projected into it.
struct Projection<'a> {
    /// Rays that see the heart.
    rays: ViewRays,
    /// Attenuation of the vessels in the image, per mm.
    attenuation: f64,
    change: &'a Image,
    strongest: f32,
}

impl Projection<'_> {
    /// Returns the shadows of the points of a tree in an image of a size.
    fn shadows(&self, tree: &PhaseTree, size: [usize; 2]) -> Shadows {
        let starts = tree.branches.iter().scan(0, |next, branch| {
            let start = *next;
            *next += branch.points_mm.len();
            Some(start)
        });
        let all = tree.branches.iter().zip(starts).flat_map(|(branch, start)| self.of_branch(branch, start));
        Shadows::new(all, size)
    }

    /// Returns the shadows of the points of a branch, whose first point has an index.
    fn of_branch(&self, branch: &Branch, start: usize) -> Vec<PointShadow> {
        let points = &branch.points_mm;
        let last = points.len() - 1;
        let length_mm = |i: usize| {
            let [before, behind] = [points[i.saturating_sub(1)], points[(i + 1).min(last)]];
            0.5 * (before.distance(points[i]) + points[i].distance(behind))
        };
        let moved = self.moved_to_ridges(branch);
        let shadow = |i: usize| {
            let centre = moved[i]?;
            let pixel_mm2 = pixel_mm2(&self.rays, points[i]);
            let radius_px = branch.radius_mm[i] / pixel_mm2.sqrt();
            Some(PointShadow {
                point: start + i,
                centre,
                // Variances of a disc, of a pixel and of the blur.
                deviation_px: (radius_px.powi(2) / 4.0 + 1.0 / 12.0 + BLUR_PX.powi(2)).sqrt(),
                sum: self.attenuation * length_mm(i) / pixel_mm2,
            })
        };
        (0..points.len()).filter_map(shadow).collect()
    }

    fn projected(&self, point_mm: DVec3) -> Option<DVec2> {
        self.rays.project(world_from_lps_mm(point_mm)).map(|(column, row)| DVec2::new(column, row))
    }

    /// Returns the points of a branch in the image, moved across the vessel to the ridge that the image shows nearby; `None` behind the source.
    fn moved_to_ridges(&self, branch: &Branch) -> Vec<Option<DVec2>> {
        let tangents = tangents(&branch.points_mm);
        let places: Vec<Option<DVec2>> = branch.points_mm.iter().map(|point| self.projected(*point)).collect();
        let across = |i: usize| {
            let ahead = self.projected(branch.points_mm[i] + tangents[i])?;
            (ahead - places[i]?).perp().try_normalize()
        };
        let offset = |i: usize| {
            let found = ridge_offset(self.change, self.strongest, places[i]?, across(i)?)?;
            (found.abs() <= FARTHEST_RIDGE_PX).then_some(found as f32)
        };
        let offsets: Vec<Option<f32>> = (0..places.len()).map(offset).collect();
        let smooth = |i: usize| {
            let around = &offsets[i.saturating_sub(RIDGE_POINTS)..(i + RIDGE_POINTS + 1).min(offsets.len())];
            let mut known: Vec<f32> = around.iter().copied().flatten().collect();
            if known.len() < MIN_RIDGES { 0.0 } else { f64::from(median(&mut known)) }
        };
        (0..places.len()).map(|i| Some(places[i]? + across(i).unwrap_or(DVec2::ZERO) * smooth(i))).collect()
    }
}
