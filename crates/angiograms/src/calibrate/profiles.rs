//! Epipolar profiles (method, robustness of geometry, section 4): integrals of a view's image over each plane through two
//! sources. At the true geometry both views of a pair have equal profiles.
//!
//! A plane is identified by its angle about the baseline. Angle zero is a direction that both views share, so that a common
//! motion of all views changes nothing. With a baseline `e`, a ray of direction `d` has `s = e.d` along it and `a = n1.d`,
//! `b = n2.d` across; its weight is `solid angle / cos^2 latitude`. All slopes of a profile follow from three sums over the
//! pixels of a plane: of the weight, and of the weight times `s a / (a^2 + b^2)` and `s b / (a^2 + b^2)`.

use crate::calibrate::pose::{Poses, StatedView};
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::ops::Range;

/// Minimum length of a baseline, as a share of the distance from source to isocentre.
const SHORTEST_BASELINE: f64 = 0.1;
/// Minimum distance between baseline and isocentre, as a share of the distance from source to isocentre. The baseline of
/// opposite views runs through the heart, where planes cannot be told apart.
const MIN_DISTANCE: f64 = 0.35;
/// Bins per pixel.
const BINS_PER_PIXEL: f64 = 2.0;
/// Reach of a kernel in standard deviations.
const KERNEL_REACH: f64 = 3.5;

/// A pixel that takes part.
#[derive(Debug, Clone, Copy)]
pub struct Pixel {
    /// Column.
    pub column: f64,
    /// Row.
    pub row: f64,
    /// Square of its direction's length.
    squared: f64,
    /// Solid angle.
    solid: f64,
}

impl Pixel {
    fn new(stand: &StatedView, column: f64, row: f64) -> Pixel {
        let [d0, du, dv] = stand.rays.direction;
        let squared = (d0 + du * column + dv * row).length_squared();
        Pixel { column, row, squared, solid: d0.dot(du.cross(dv)).abs() / (squared * squared.sqrt()) }
    }
}

/// Data of a view for the comparison: pixels, and the difference of each phase from the static background there.
#[derive(Debug, Clone)]
pub struct Moving {
    /// Geometry of the view.
    pub stand: StatedView,
    /// Columns and rows of its images.
    pub size: [usize; 2],
    /// Pixels that take part.
    pub pixels: Vec<Pixel>,
    /// A value per pixel for each phase; `None` where the view has no image.
    pub phases: Vec<Option<Vec<f32>>>,
}

impl Moving {
    /// Creates the data from a view's images, within `mask`.
    pub fn new(stand: StatedView, size: [usize; 2], mask: &[bool], images: &[Option<Vec<f32>>]) -> Moving {
        let kept: Vec<usize> = (0..mask.len()).filter(|p| mask[*p]).collect();
        let pixel = |p: &usize| Pixel::new(&stand, (p % size[0]) as f64, (p / size[0]) as f64);
        let pixels = kept.iter().map(pixel).collect();
        let take = |image: &Vec<f32>| kept.iter().map(|p| image[*p]).collect();
        let phases = images.iter().map(|image| image.as_ref().map(take)).collect();
        Moving { stand, size, pixels, phases }
    }

    /// Returns the data as if another view had taken the images.
    pub fn seen_from(&self, stand: StatedView) -> Moving {
        let pixels = self.pixels.iter().map(|pixel| Pixel::new(&stand, pixel.column, pixel.row)).collect();
        Moving { pixels, stand, ..self.clone() }
    }
}

/// Pencil of planes of a pair at a phase.
#[derive(Debug, Clone, Copy)]
pub struct Pencil {
    /// Unit vector from the first source to the second.
    pub baseline: DVec3,
    /// Unit vector across the baseline, at angle zero.
    pub first: DVec3,
    /// Unit vector across both `baseline` and `first`.
    pub second: DVec3,
    /// Length of the baseline.
    pub length: f64,
    /// Component of the shared direction across the baseline, and along it.
    pub middle: [f64; 2],
}

/// Profile of a pair and its slopes, in one view and at one phase.
#[derive(Debug, Clone)]
pub struct Profile {
    /// Integral of density / (distance from the baseline)^2 in each plane.
    pub value: Vec<f64>,
    /// Change of `value` per radian by which the zero direction turns about the baseline.
    pub turned: Vec<f64>,
    /// Change of `value` when the baseline tilts towards `first`, per radian.
    pub towards_first: Vec<f64>,
    /// Change of `value` when the baseline tilts towards `second`, per radian.
    pub towards_second: Vec<f64>,
}

/// Profiles of both views of a pair at a phase.
#[derive(Debug, Clone)]
pub struct PairAtPhase {
    /// Phase.
    pub phase: usize,
    /// Pencil of planes.
    pub pencil: Pencil,
    /// Number of the first bin, counted from the plane of angle zero.
    pub first_bin: i64,
    /// The views' profiles.
    pub profiles: [Profile; 2],
}

/// Two views, by their index among the calibrated ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pair {
    /// The two views of the pair.
    pub views: [usize; 2],
}

/// Width of the stripes of planes that are kept for a test, bins of half a pixel: several times the detail that the fine stages compare.
const STRIPE: i64 = 32;

/// Planes of each pencil that take part.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Planes {
    /// All planes.
    All,
    /// Every second stripe, from that of angle zero on.
    Even,
    /// The other stripes.
    Odd,
}

impl Planes {
    /// Tells whether a plane takes part, by its bin counted from the plane of angle zero.
    pub fn hold(self, bin: i64) -> bool {
        let is_even = bin.div_euclid(STRIPE) % 2 == 0;
        match self {
            Planes::All => true,
            Planes::Even => is_even,
            Planes::Odd => !is_even,
        }
    }
}

/// All views that are made consistent.
#[derive(Debug, Clone)]
pub struct Views {
    /// The views.
    pub views: Vec<Moving>,
    /// Pairs that constrain each other.
    pub pairs: Vec<Pair>,
    /// Cardiac phases.
    pub n_phases: usize,
    /// Whether the images show vessels and nothing else, so that profiles at rest are no error of a background.
    pub vessels_alone: bool,
    /// Width of a bin, radians.
    pub bin: f64,
}

/// A smoothing kernel of profiles, and its slope per bin.
pub struct Blur {
    value: Vec<f64>,
    slope: Vec<f64>,
}

impl Blur {
    /// A Gaussian of standard deviation `sigma`, bins.
    pub fn gaussian(sigma: f64) -> Blur {
        let reach = (KERNEL_REACH * sigma).ceil() as i32;
        Blur { value: gaussian(sigma, reach), slope: gaussian_slope(sigma, reach) }
    }

    /// Returns a Gaussian of `sigma` bins minus one of `wide` bins, which suppresses structures as smooth as a moving heart
    /// or lung.
    pub fn band(sigma: f64, wide: f64) -> Blur {
        let reach = (KERNEL_REACH * wide).ceil() as i32;
        let less = |a: Vec<f64>, b: Vec<f64>| a.iter().zip(b).map(|(a, b)| a - b).collect();
        Blur {
            value: less(gaussian(sigma, reach), gaussian(wide, reach)),
            slope: less(gaussian_slope(sigma, reach), gaussian_slope(wide, reach)),
        }
    }
}

fn gaussian(sigma: f64, reach: i32) -> Vec<f64> {
    let weights: Vec<f64> = (-reach..=reach).map(|i| (-0.5 * (f64::from(i) / sigma).powi(2)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    weights.iter().map(|w| w / sum).collect()
}

fn gaussian_slope(sigma: f64, reach: i32) -> Vec<f64> {
    gaussian(sigma, reach).iter().zip(-reach..=reach).map(|(g, i)| -f64::from(i) / (sigma * sigma) * g).collect()
}

/// Convolves `values` with `kernel`; values outside are zero.
fn convolved(values: &[f64], kernel: &[f64]) -> Vec<f64> {
    let reach = kernel.len() / 2;
    let mut out = vec![0.0; values.len()];
    for (at, value) in values.iter().enumerate().filter(|(_, v)| **v != 0.0) {
        let first = at.saturating_sub(reach);
        let last = (at + reach + 1).min(values.len());
        let taps = &kernel[first + reach - at..last + reach - at];
        out[first..last].iter_mut().zip(taps).for_each(|(out, tap)| *out += value * tap);
    }
    out
}

impl Views {
    /// Finds the pairs that constrain each other.
    pub fn new(views: Vec<Moving>, n_phases: usize) -> Views {
        let side = |v: &Moving| 0.5 * (v.stand.rays.direction[1].length() + v.stand.rays.direction[2].length());
        let pixel = views.iter().map(side).sum::<f64>() / views.len().max(1) as f64;
        let all = (0..views.len()).flat_map(|b| (0..b).map(move |a| Pair { views: [a, b] }));
        let pairs = all.filter(|p| tells(&views[p.views[0]].stand, &views[p.views[1]].stand)).collect();
        Views { views, pairs, n_phases, vessels_alone: false, bin: pixel / BINS_PER_PIXEL }
    }

    /// Phases that both views of a pair have, among those wanted.
    pub fn phases_of<'a>(&'a self, pair: Pair, wanted: &'a [usize]) -> impl Iterator<Item = usize> + 'a {
        wanted.iter().copied().filter(move |t| pair.views.iter().all(|v| self.views[*v].phases[*t].is_some()))
    }

    fn turns(&self, pair: Pair, poses: &Poses) -> [DMat3; 2] {
        pair.views.map(|v| self.views[v].stand.turn(&poses.views[v]))
    }

    /// Returns the pencil of planes of a pair at a phase.
    pub fn pencil(&self, pair: Pair, poses: &Poses, phase: usize) -> Pencil {
        let source = |v: usize| self.views[v].stand.source(&poses.views[v]) - poses.heart[v][phase];
        let axis = |v: usize| self.views[v].stand.corrected_axes(&poses.views[v]).z_axis;
        let [a, b] = pair.views;
        let between = source(b) - source(a);
        let length = between.length();
        let baseline = between / length;
        let middle = axis(a) + axis(b);
        let along = middle.dot(baseline);
        let across = middle - along * baseline;
        let first = across.normalize();
        Pencil { baseline, first, second: baseline.cross(first), length, middle: [across.length(), along] }
    }

    /// Bins that the images of a pair cover at any of the phases.
    fn range(&self, pair: Pair, poses: &Poses, phases: &[usize]) -> Range<i64> {
        let turns = self.turns(pair, poses);
        let (mut low, mut high) = (f64::MAX, f64::MIN);
        for phase in phases {
            let pencil = self.pencil(pair, poses, *phase);
            for (v, turn) in pair.views.into_iter().zip(turns) {
                let [w, h] = self.views[v].size.map(|n| n as f64 - 1.0);
                for (column, row) in [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)] {
                    let d = turn * self.views[v].stand.rays.pixel(column, row).1;
                    let angle = pencil.second.dot(d).atan2(pencil.first.dot(d)) / self.bin;
                    (low, high) = (low.min(angle), high.max(angle));
                }
            }
        }
        low.floor() as i64 - 1..high.ceil() as i64 + 2
    }

    /// Computes the profiles of a pair at all wanted phases that both views have.
    pub fn profiles(&self, pair: Pair, poses: &Poses, wanted: &[usize], blur: &Blur) -> Vec<PairAtPhase> {
        let phases: Vec<usize> = self.phases_of(pair, wanted).collect();
        let range = self.range(pair, poses, &phases);
        let turns = self.turns(pair, poses);
        let at = |phase: usize| {
            let pencil = self.pencil(pair, poses, phase);
            let profile = |k: usize| {
                let view = &self.views[pair.views[k]];
                let values = view.phases[phase].as_deref().unwrap_or_default();
                Sums::of(view, values, &pencil, turns[k], &range, self.bin).profile(blur, self.bin)
            };
            PairAtPhase { phase, pencil, first_bin: range.start, profiles: [profile(0), profile(1)] }
        };
        phases.into_par_iter().map(at).collect()
    }
}

/// Tells whether a pair's baseline distinguishes planes of the heart.
fn tells(a: &StatedView, b: &StatedView) -> bool {
    let (from, to) = (a.rays.source(), b.rays.source());
    let sod = 0.5 * (a.sod() + b.sod());
    let Some(along) = (to - from).try_normalize() else { return false };
    let distance = (from - from.dot(along) * along).length();
    (to - from).length() > SHORTEST_BASELINE * sod && distance > MIN_DISTANCE * sod
}

/// Sums over the pixels of each plane: of the weight, and of the weight times `s a / (a^2 + b^2)` and `s b / (a^2 + b^2)`.
struct Sums([Vec<f64>; 3]);

impl Sums {
    fn of(view: &Moving, values: &[f32], pencil: &Pencil, turn: DMat3, range: &Range<i64>, bin: f64) -> Sums {
        // Transforms the pencil's axes into the stated view's world, so that pixels need no rotation.
        let back = turn.transpose();
        let stated = view.stand.rays.direction;
        let along = |axis: DVec3| stated.map(|d| (back * axis).dot(d));
        let [along_s, along_a, along_b] = [pencil.baseline, pencil.first, pencil.second].map(along);
        let n = (range.end - range.start) as usize;
        let mut sums = [(); 3].map(|()| vec![0.0; n]);
        let bins = 1.0 / bin;
        for (pixel, value) in view.pixels.iter().zip(values).filter(|(_, value)| **value != 0.0) {
            let at = |p: &[f64; 3]| p[0] + pixel.column * p[1] + pixel.row * p[2];
            let (s, a, b) = (at(&along_s), at(&along_a), at(&along_b));
            let across = a * a + b * b;
            let weight = f64::from(*value) * pixel.solid * pixel.squared / across;
            let position = b.atan2(a) * bins - range.start as f64;
            let low = (position.floor() as usize).min(n - 2);
            let share = position - low as f64;
            let tilt = s / across;
            for (sum, w) in sums.iter_mut().zip([weight, weight * tilt * a, weight * tilt * b]) {
                sum[low] += w * (1.0 - share);
                sum[low + 1] += w * share;
            }
        }
        Sums(sums)
    }

    fn profile(&self, blur: &Blur, bin: f64) -> Profile {
        let Sums([weight, a, b]) = self;
        // The slope is per bin; angles are in radians.
        let slope = |sums: &[f64]| -> Vec<f64> { convolved(sums, &blur.slope).into_iter().map(|v| v / bin).collect() };
        let sum = |of: Vec<f64>, twice: Vec<f64>, sign: f64| -> Vec<f64> {
            of.iter().zip(twice).map(|(slope, v)| sign * slope + 2.0 * v).collect()
        };
        Profile {
            value: convolved(weight, &blur.value),
            turned: slope(weight),
            towards_first: sum(slope(b), convolved(a, &blur.value), -1.0),
            towards_second: sum(slope(a), convolved(b, &blur.value), 1.0),
        }
    }
}
