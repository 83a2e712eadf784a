//! Radii of vessels from the images that they were reconstructed from.
//!
//! A field of limited resolution shows thin vessels and short stenoses blurred. Images show them blurred as well, but the sum of line
//! integrals across the shadow of a vessel stays in proportion to its area, however thin it is. The areas of all points of a tree are
//! found together by least squares: the shadows of the centrelines are added to the static background of each view, so that vessels that lie
//! over each other in a view share its pixels.

use crate::calibrate::observed::binned_to;
use crate::evidence::background::Background;
use crate::evidence::series::{Series, blur};
use crate::geometry::{MM_PER_UNIT, ViewRays, world_from_lps_mm};
use crate::raster::{Image, median, median_filter, percentile};
use crate::scan::dataset::Dataset;
use crate::trees::refine::tangents;
use crate::trees::ridges::ridge_offset;
use crate::trees::shadows::{PointShadow, Shadows};
use crate::trees::tree::{BeatTree, Branch, PhaseTree, RadiiFrom};
use glam::{DVec2, DVec3};
use rayon::prelude::*;
use std::f64::consts::PI;

/// Minimum smaller side, pixels, of the binned images in which areas are measured.
const SIDE: usize = 200;
/// Standard deviation of the blur of images and shadows, pixels: errors of the places of centrelines matter less in blurred images.
const BLUR_PX: f64 = 0.6;
/// Error of a shadow, as a share of its line integral.
const SHADOW_ERROR: f64 = 0.1;
/// Residual from which a pixel loses weight, in standard deviations (Huber).
const OUTLIER: f64 = 2.5;
/// Difference of the areas that both halves of the views show, as a share of the typical area, at which half of what images add to the field
/// is believed.
const DISAGREEMENT: f64 = 0.25;
/// Rounds of weights and areas.
const ROUNDS: usize = 3;
/// Standard deviation of the difference of an area from that of the field, as a share of the typical area.
const FROM_FIELD: f64 = 1.0;
/// Additional certainty of the field for vessels of two resolution lengths, in units of that for thin ones, and the power of the diameter with
/// which it grows: the field shows wide vessels well, and the middle of their shadows is never uncovered.
const WIDE_CERTAINTY: f64 = 30.0;
const WIDE_POWER: i32 = 12;
/// Standard deviation of the difference of two successive radii, as a share of the typical radius.
const STEP_CHANGE: f64 = 0.25;
/// Minimum radius, as a share of the typical one, for which differences of radii are expressed by those of areas.
const MIN_SHARE: f64 = 0.3;
/// Number of points on each side over which the typical area is a median, and then a mean.
const TYPICAL_MEDIAN: usize = 15;
const TYPICAL_MEAN: usize = 5;
/// Minimum typical area, in units of the square of the field's resolution.
const MIN_TYPICAL: f64 = 0.06;
/// Factor on the certainty of the field at the end of a branch, and the number of points over which it falls: shadows go on beyond ends and are
/// shared at bifurcations.
const END_CERTAINTY: f64 = 300.0;
const END_POINTS: f64 = 2.0;
/// Largest distance of a centreline from the ridge of its shadow, pixels: a ridge farther away belongs to another vessel.
const FARTHEST_RIDGE_PX: f64 = 1.6;
/// Number of points on each side over which distances from ridges are averaged, and how many of them must have a ridge.
const RIDGE_POINTS: usize = 4;
const MIN_RIDGES: usize = 4;
/// Share of the changes of a pixel from phase to phase that is an error of the shadows there.
const OF_CHANGES: f64 = 0.4;
/// Radius of the median filter of the changes from phase to phase, pixels.
const STEADY_PX: usize = 2;
/// Minimum number of views: radii of one alone could not be compared.
const MIN_VIEWS: usize = 2;
/// Minimum number of phases that a view must show: its static background is found from their differences.
const MIN_PHASES: usize = 3;
/// Minimum radius, in units of the field's resolution.
const MIN_RADIUS: f64 = 0.03;
/// Maximum number of iterations of the conjugate gradients, and the residual at which they end.
const MAX_ITERATIONS: usize = 200;
const RESIDUAL: f64 = 1e-6;

/// Replaces the radii of a tree whose points are followed by those that the training images show. The dataset has the geometry that the
/// reconstruction used.
///
/// # Errors
/// The reason why the radii stay those of the field.
pub fn measure_radii(beat: &mut BeatTree, dataset: &Dataset) -> Result<(), &'static str> {
    if beat.reference_phase.is_none() {
        return Err("the points of the tree are not followed over the beat");
    }
    let attenuation = beat
        .vessel_per_mm
        .ok_or("the attenuation of the vessels is not known, or contrast fills them over the beat")?;
    let first = beat.phases.first().ok_or("the tree has no phase")?;
    let field: Vec<f64> = first.branches.iter().flat_map(|b| &b.radius_mm).map(|r| PI * r * r).collect();
    let lengths: Vec<usize> = first.branches.iter().map(|branch| branch.points_mm.len()).collect();
    let dataset = &binned_to(dataset, SIDE);
    let of_view = |series: Series| ShadowedView::new(series, dataset, &beat.phases, attenuation);
    let mut views: Vec<ShadowedView> = Series::each(dataset).filter_map(of_view).collect();
    if views.len() < MIN_VIEWS {
        return Err("fewer than two training views show three phases of the tree");
    }
    let expected = Expected::new(&field, &lengths, beat.resolution_mm);
    let mut areas = field.clone();
    for _ in 0..ROUNDS {
        views.iter_mut().for_each(|view| view.weigh(&areas));
        areas = solved(&views.iter().collect::<Vec<_>>(), &expected, &areas);
    }
    let areas = believed(&views, &expected, areas);
    let least_mm = MIN_RADIUS * beat.resolution_mm;
    let radii: Vec<f64> = areas.iter().map(|area| (area.max(0.0) / PI).sqrt().max(least_mm)).collect();
    for tree in &mut beat.phases {
        let mut rest = radii.as_slice();
        for branch in &mut tree.branches {
            let (own, others) = rest.split_at(branch.points_mm.len());
            branch.radius_mm = own.to_vec();
            rest = others;
        }
    }
    beat.radii_from = RadiiFrom::Images;
    Ok(())
}

/// An image of a view and the shadows of the tree in it.
struct ShadowedFrame {
    shadows: Shadows,
    /// Line integrals, blurred.
    image: Vec<f64>,
    weights: Vec<f64>,
}

/// The images of a view.
struct ShadowedView {
    frames: Vec<ShadowedFrame>,
    /// Variance of each pixel of the blurred images: of its noise, and of a share of its changes from phase to phase.
    variance: Vec<f64>,
    /// Whether each pixel shows the patient.
    shown: Vec<bool>,
}

impl ShadowedView {
    /// Returns the images of a view that show phases of the tree; `None` where there are too few.
    fn new(series: Series, dataset: &Dataset, phases: &[PhaseTree], attenuation: f64) -> Option<ShadowedView> {
        let background = Background::new(series);
        let view = background.stilled.view;
        let size = dataset.views[view].size;
        let frame = |tree: &PhaseTree| {
            let image = background.stilled.images.get(tree.phase as usize)?.as_ref()?;
            let change = background.changes.get(tree.phase as usize)?.as_ref()?;
            let projection = Projection {
                rays: dataset.heart_rays_at(view, tree.phase),
                attenuation: attenuation * dataset.contrast_at(view, tree.phase),
                change,
                strongest: background.strongest,
            };
            let image = blur(image, BLUR_PX as f32).values.into_iter().map(f64::from).collect();
            Some(ShadowedFrame { shadows: projection.shadows(tree, size), image, weights: Vec::new() })
        };
        let frames: Vec<ShadowedFrame> = phases.par_iter().filter_map(frame).collect();
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
        Some(ShadowedView { frames, variance, shown })
    }

    fn n_pixels(&self) -> usize {
        self.variance.len()
    }

    /// Sets the weights of all pixels for areas: the inverse of their variances, less for outliers and none for hidden pixels.
    fn weigh(&mut self, areas: &[f64]) {
        let n = self.n_pixels();
        let models: Vec<Vec<f64>> = self.frames.par_iter().map(|frame| frame.shadows.image(areas, n)).collect();
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

    /// Adds to each point the weighted sums of images, one for each frame, without their weighted means over the frames: the static background
    /// of a pixel is unknown.
    fn add_sums(&self, images: &[Vec<f64>], sums: &mut [f64]) {
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
            let mut own = vec![0.0; sums.len()];
            frame.shadows.add_sums(&weighted, &mut own);
            own
        };
        let all: Vec<Vec<f64>> = self.frames.par_iter().zip(images).map(of_frame).collect();
        all.iter().for_each(|own| sums.iter_mut().zip(own).for_each(|(sum, value)| *sum += value));
    }

    /// Returns the line integrals of vessels with areas in all frames.
    fn images(&self, areas: &[f64]) -> Vec<Vec<f64>> {
        self.frames.par_iter().map(|frame| frame.shadows.image(areas, self.n_pixels())).collect()
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
            let pixel_mm2 = self.pixel_mm2(points[i]);
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

    /// Returns the area of a pixel at a point, perpendicular to the ray, mm^2.
    fn pixel_mm2(&self, point_mm: DVec3) -> f64 {
        let away = world_from_lps_mm(point_mm) - self.rays.source();
        let depth_mm = away.dot(self.rays.axis()).abs() * MM_PER_UNIT;
        let obliquity = away.normalize_or(self.rays.axis()).dot(self.rays.axis()).abs();
        self.rays.direction[1].cross(self.rays.direction[2]).length() * depth_mm.powi(2) * obliquity
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

/// Areas that are expected before the images are compared, and how certain they are.
struct Expected<'a> {
    /// Areas of the field, mm^2.
    field: &'a [f64],
    /// Inverse variance of the difference from the field's area.
    certainty: Vec<f64>,
    /// Typical area around each point, mm^2.
    typical: Vec<f64>,
    /// Whether a point is followed by another one of its branch.
    goes_on: Vec<bool>,
}

impl Expected<'_> {
    /// Returns the expectation for branches of numbers of points, from a field of a resolution.
    fn new<'a>(field: &'a [f64], lengths: &[usize], resolution_mm: f64) -> Expected<'a> {
        let mut expected = Expected { field, certainty: Vec::new(), typical: Vec::new(), goes_on: Vec::new() };
        let mut rest = field;
        for n in lengths {
            let (own, others) = rest.split_at(*n);
            rest = others;
            for (i, area) in typical(own).into_iter().enumerate() {
                let area = area.max(MIN_TYPICAL * resolution_mm.powi(2));
                let end = i.min(n - 1 - i) as f64;
                let at_end = END_CERTAINTY * (-0.5 * (end / END_POINTS).powi(2)).exp();
                let half_widths = (area / PI).sqrt() / resolution_mm;
                let wide = WIDE_CERTAINTY * half_widths.powi(WIDE_POWER);
                expected.certainty.push((FROM_FIELD.powi(-2) + at_end + wide) / area.powi(2));
                expected.typical.push(area);
                expected.goes_on.push(i + 1 < *n);
            }
        }
        expected
    }

    /// Returns the inverse variances of the differences of successive areas, for which the differences of their radii are expected to be small.
    fn smoothness(&self, areas: &[f64]) -> Vec<f64> {
        let step = |i: usize| {
            if !self.goes_on[i] {
                return 0.0;
            }
            let typical = 0.5 * (self.typical[i] + self.typical[i + 1]);
            let share = (0.5 * (areas[i] + areas[i + 1]) / typical).max(MIN_SHARE.powi(2));
            // The area is pi r^2, and its difference 2 pi r times that of the radius.
            (2.0 * STEP_CHANGE * typical).powi(-2) / share
        };
        (0..areas.len()).map(step).collect()
    }

    /// Returns the gradient of half the squared, weighted differences of areas: those of successive ones, and those from zero.
    fn applied(&self, smoothness: &[f64], areas: &[f64]) -> Vec<f64> {
        let mut out: Vec<f64> = areas.iter().zip(&self.certainty).map(|(area, weight)| area * weight).collect();
        for i in 0..areas.len() - 1 {
            let force = smoothness[i] * (areas[i] - areas[i + 1]);
            out[i] += force;
            out[i + 1] -= force;
        }
        out
    }
}

/// Returns the typical area around each point of a branch, mm^2: short narrowings do not change it.
fn typical(areas: &[f64]) -> Vec<f64> {
    let around = |values: &[f32], i: usize, reach: usize| {
        values[i.saturating_sub(reach)..(i + reach + 1).min(values.len())].to_vec()
    };
    let areas: Vec<f32> = areas.iter().map(|area| *area as f32).collect();
    let medians: Vec<f32> = (0..areas.len()).map(|i| percentile(&around(&areas, i, TYPICAL_MEDIAN), 0.5)).collect();
    let mean = |i: usize| {
        let part = around(&medians, i, TYPICAL_MEAN);
        f64::from(part.iter().sum::<f32>()) / part.len() as f64
    };
    (0..areas.len()).map(mean).collect()
}

/// Returns the areas that explain the images best, by conjugate gradients from given areas.
fn solved(views: &[&ShadowedView], expected: &Expected<'_>, start: &[f64]) -> Vec<f64> {
    let smoothness = expected.smoothness(start);
    let applied = |areas: &[f64]| {
        let mut out = expected.applied(&smoothness, areas);
        views.iter().for_each(|view| view.add_sums(&view.images(areas), &mut out));
        out
    };
    let mut right: Vec<f64> =
        expected.field.iter().zip(&expected.certainty).map(|(area, weight)| area * weight).collect();
    for view in views {
        let images: Vec<Vec<f64>> = view.frames.iter().map(|frame| frame.image.clone()).collect();
        view.add_sums(&images, &mut right);
    }
    conjugate_gradients(applied, &right, start)
}

/// Returns the areas where both halves of the views agree on them, and those of the field where they do not: where vessels lie over each other in
/// some views, shadows there may be shared wrongly.
fn believed(views: &[ShadowedView], expected: &Expected<'_>, areas: Vec<f64>) -> Vec<f64> {
    let half = |first: usize| {
        let own: Vec<&ShadowedView> = views.iter().skip(first).step_by(2).collect();
        solved(&own, expected, &areas)
    };
    let (even, odd) = (half(0), half(1));
    let share = |i: usize| {
        let apart = (even[i] - odd[i]) / (DISAGREEMENT * expected.typical[i]);
        1.0 / (1.0 + apart * apart)
    };
    (0..areas.len()).map(|i| expected.field[i] + share(i) * (areas[i] - expected.field[i])).collect()
}

/// Solves a symmetric positive definite system that is given by its product with a vector.
fn conjugate_gradients(applied: impl Fn(&[f64]) -> Vec<f64>, right: &[f64], start: &[f64]) -> Vec<f64> {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut x = start.to_vec();
    let mut residual: Vec<f64> = right.iter().zip(applied(&x)).map(|(b, a)| b - a).collect();
    let mut way = residual.clone();
    let mut square = dot(&residual, &residual);
    let enough = RESIDUAL.powi(2) * dot(right, right);
    for _ in 0..MAX_ITERATIONS {
        if square <= enough {
            break;
        }
        let product = applied(&way);
        let step = square / dot(&way, &product);
        x.iter_mut().zip(&way).for_each(|(x, way)| *x += step * way);
        residual.iter_mut().zip(&product).for_each(|(r, product)| *r -= step * product);
        let next = dot(&residual, &residual);
        way.iter_mut().zip(&residual).for_each(|(way, r)| *way = r + next / square * *way);
        square = next;
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CArm, Geometry};
    use crate::scan::dataset::{Frame, Layout, Split, View};

    const PER_MM: f64 = 0.1;
    const PIXEL_MM: f64 = 1.6;
    const SIZE: [usize; 2] = [40, 50];
    const PHASES: u32 = 5;

    /// Radius of the true vessel: a stenosis of 60 % and 9 mm.
    fn radius_mm(z: f64) -> f64 {
        let away = (z - 4.0) / 9.0;
        0.7 * if away.abs() < 0.5 { 1.0 - 0.3 * (1.0 + (2.0 * PI * away).cos()) } else { 1.0 }
    }

    /// Place of the vessel's axis along left and posterior at a phase, mm.
    fn axis_mm(phase: u32) -> [f64; 2] {
        [5.0 * f64::from(phase) - 11.0, 4.0 * f64::from((2 * phase) % PHASES) - 7.0]
    }

    fn contrast(phase: u32) -> f64 {
        if phase == 1 || phase == 3 { 0.4 } else { 1.0 }
    }

    /// Images from the front and from the side of a vessel along the head's direction over a sloping background: exact chords, 8 x 8 of them
    /// in a pixel.
    fn dataset() -> Dataset {
        dataset_with(|_, _| 1.0)
    }

    /// Images of a vessel whose radius a view shows enlarged by a factor of the place along the vessel, mm.
    fn dataset_with(enlarged: impl Fn(usize, f64) -> f64) -> Dataset {
        let view = |primary_deg: f64| {
            let pixel_mm = [PIXEL_MM * 1e5 / 9e4; 2];
            let (sid_mm, sod_mm, zero) = (1e5, 9e4, [0.0; 2]);
            let c_arm =
                CArm { primary_deg, secondary_deg: 0.0, sid_mm, sod_mm, pixel_mm, offset_mm: zero, table_mm: [0.0; 3] };
            View::new(Geometry::CArm(c_arm), SIZE).unwrap()
        };
        let views = vec![view(0.0), view(90.0)];
        let line_integral = |view: usize, phase: u32, column: f64, row: f64| {
            let (anchor, _) = views[view].rays.pixel(column, row);
            // World axes are (posterior, left, superior); the rays are parallel.
            let [left, posterior] = axis_mm(phase);
            let across = if view == 0 { anchor.y * MM_PER_UNIT - left } else { anchor.x * MM_PER_UNIT - posterior };
            let z = anchor.z * MM_PER_UNIT;
            let shown_mm = enlarged(view, z) * radius_mm(z);
            2.0 * PER_MM * (shown_mm.powi(2) - across * across).max(0.0).sqrt()
        };
        let pixel = |view: usize, phase: u32, p: usize| {
            let at = |k: usize| (k as f64 + 0.5) / 8.0 - 0.5;
            let (x, y) = ((p % SIZE[0]) as f64, (p / SIZE[0]) as f64);
            let sum: f64 = (0..64).map(|k| line_integral(view, phase, x + at(k % 8), y + at(k / 8))).sum();
            (contrast(phase) * sum / 64.0 + 0.8 + 0.01 * x - 0.006 * y) as f32
        };
        let frame = |view: usize, phase: u32| Frame {
            name: format!("view {view}, phase {phase}"),
            view,
            phase,
            after_phase: 0.0,
            split: Split::Train,
            integrals: (0..SIZE[0] * SIZE[1]).map(|p| pixel(view, phase, p)).collect::<Vec<f32>>().into(),
            mask: None,
            heart_shift_mm: [0.0; 3],
            contrast: contrast(phase),
        };
        Dataset {
            path: "test".into(),
            layout: Layout::Native,
            frames: (0..2)
                .flat_map(|view| (0..PHASES).map(move |phase| (view, phase)))
                .map(|(v, p)| frame(v, p))
                .collect(),
            views: views.clone(),
            width: SIZE[0],
            height: SIZE[1],
            n_phases: PHASES,
            notes: Vec::new(),
            depth_range: (-0.5, 0.5),
            hidden: Default::default(),
            vessel_attenuation: Some(PER_MM * MM_PER_UNIT),
            still: false,
            views_adjusted: false,
            prior: None,
        }
    }

    /// A tree as a blurred field shows the vessel: too wide, without the stenosis, and with centrelines off by most of a pixel.
    fn tree() -> BeatTree {
        let branch = |phase: u32| {
            let [left, posterior] = axis_mm(phase);
            let off_mm = 1.4 * if phase.is_multiple_of(2) { 1.0 } else { -1.0 };
            Branch {
                parent: None,
                points_mm: (0..60)
                    .map(|i| DVec3::new(left + off_mm, posterior - off_mm, 0.9 * f64::from(i) - 27.0))
                    .collect(),
                radius_mm: vec![0.85; 60],
                agreement: Vec::new(),
                doubt: Vec::new(),
            }
        };
        BeatTree {
            reference_phase: Some(0),
            threshold_per_mm: 0.2 * PER_MM,
            resolution_mm: 1.8,
            spacing_mm: 0.9,
            vessel_per_mm: Some(PER_MM),
            radii_from: RadiiFrom::Field,
            views: Vec::new(),
            phases: (0..PHASES).map(|phase| PhaseTree { phase, branches: vec![branch(phase)] }).collect(),
            measured_mm: Vec::new(),
        }
    }

    #[test]
    fn images_show_a_stenosis_that_the_field_does_not() {
        let mut beat = tree();
        measure_radii(&mut beat, &dataset()).unwrap();
        assert_eq!(beat.radii_from, RadiiFrom::Images);
        let branch = &beat.phases[2].branches[0];
        let off = |i: usize| (branch.radius_mm[i] - radius_mm(branch.points_mm[i].z)).abs();
        let worst = (8..52).max_by(|a, b| off(*a).total_cmp(&off(*b))).unwrap();
        assert!(off(worst) < 0.06, "{} mm at {}: {:?}", off(worst), branch.points_mm[worst].z, branch.radius_mm);
        assert!(
            beat.phases.iter().all(|tree| tree.branches[0].radius_mm == branch.radius_mm),
            "points keep their radii"
        );
    }

    #[test]
    fn the_field_decides_where_halves_of_the_views_disagree() {
        // One view shows a part of the vessel wider than the other one. Both together would give a radius of 0.87 mm.
        let wider = |view: usize, z: f64| if view == 0 && z > -18.0 && z < -8.0 { 1.6 } else { 1.0 };
        let field = 1.0;
        let mut beat = tree();
        beat.phases.iter_mut().for_each(|tree| tree.branches[0].radius_mm.fill(field));
        measure_radii(&mut beat, &dataset_with(wider)).unwrap();
        let branch = &beat.phases[0].branches[0];
        let radius_at = |z: f64| {
            let i = branch.points_mm.iter().position(|p| p.z > z).unwrap();
            branch.radius_mm[i]
        };
        assert!((radius_at(-13.0) - field).abs() < 0.05, "{:?}", branch.radius_mm);
        assert!(
            (radius_at(12.0) - radius_mm(12.0)).abs() < 0.06,
            "elsewhere the images decide: {:?}",
            branch.radius_mm
        );
    }

    #[test]
    fn radii_stay_where_images_do_not_tell_them() {
        let dataset = dataset();
        let refused = |beat: &mut BeatTree, dataset: &Dataset, reason: &str| {
            let before = beat.clone();
            let told = measure_radii(beat, dataset).unwrap_err();
            assert!(told.contains(reason) && *beat == before, "{told}");
        };
        refused(&mut BeatTree { vessel_per_mm: None, ..tree() }, &dataset, "attenuation");
        refused(&mut BeatTree { reference_phase: None, ..tree() }, &dataset, "not followed");
        let mut short = tree();
        short.keep_phases(&[0, 4]);
        assert_eq!(short.phases.iter().map(|tree| tree.phase).collect::<Vec<_>>(), [0, 4]);
        refused(&mut short, &dataset, "three phases");
        let mut one_view = dataset.clone();
        one_view.frames.retain(|frame| frame.view == 0);
        refused(&mut tree(), &one_view, "two training views");
    }

    #[test]
    fn the_system_is_solved() {
        // Diagonally dominant, symmetric.
        let applied = |x: &[f64]| vec![4.0 * x[0] - x[1], 3.0 * x[1] - x[0] + 0.5 * x[2], 2.0 * x[2] + 0.5 * x[1]];
        let wanted = [1.0, -2.0, 0.7];
        let found = conjugate_gradients(applied, &applied(&wanted), &[0.0; 3]);
        assert!(found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-5), "{found:?}");
    }
}
