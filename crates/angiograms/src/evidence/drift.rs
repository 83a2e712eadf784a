//! Wide motion of a view other than that of vessels: a diaphragm, a heart, a lung. The edges of such a structure may be as
//! thin as vessels, but they move with its inside, so that a few courses over the phases describe all of it. Courses are
//! found in the images after a median filter wider than any vessel. Each course has a mode, the line integral it adds to
//! each pixel.

use crate::evidence::filters::map2;
use crate::evidence::series::{MIN_NOISE_SHARE, STRONGEST_PERCENTILE, Series, blur, opening_radius};
use crate::raster::{Image, median, median_filter, percentile};
use rayon::prelude::*;

/// Smaller side, pixels, of the images in which wide structures are looked for.
const SIDE: usize = 100;
/// Radius of the median filter that removes vessels, as a share of the smaller side.
const WIDE_SHARE: f64 = 0.09;
/// Maximum number of courses of a view.
const MAX_COURSES: usize = 3;
/// Phases needed per course: with as many courses as independent phase differences, anything could be described, even a
/// vessel.
const PHASES_PER_COURSE: usize = 3;
/// Rounds of the power iteration that finds a course.
const POWER_ROUNDS: usize = 100;
/// Minimum size of a visible mode: its root mean square over the phases, as a share of the strongest change.
const MIN_SIZE: f32 = 0.02;
/// Minimum share of a view in which a mode must be visible: the remainders of crossing vessels after the median filter cover few places.
/// With 5 %, one of four diaphragms is not found (docs/tried.md).
const MIN_SPREAD: f64 = 0.03;
/// Minimum share of the wide part that a course must explain: in noise, all courses explain equal shares.
const MIN_TOLD: f32 = 0.5;
/// Iterations of the fit of a pixel.
const FIT_ROUNDS: usize = 20;
/// Residuals above this many standard deviations over the fit belong to a vessel and are limited to this value.
const VESSEL_SIGMAS: f32 = 0.7;
/// Blur over which a mode must explain the narrow part, pixels.
const TOLD_BLUR: f32 = 1.0;
/// Standard deviations above which the narrow part exceeds the noise.
const STANDS_OUT_SIGMAS: f32 = 4.0;
/// Explained shares of the narrow part at a pixel at which the confidence in a mode starts to rise from 0, and at which it
/// reaches 1.
const BELIEVED: [f32; 2] = [0.7, 0.9];
/// Edges are explained almost completely, vessels by chance in varying degrees. Of the pixels explained by half or more, at
/// least this share must be explained as well as the second of [`BELIEVED`]; otherwise all narrow parts are rejected.
const MIN_TOLD_WELL: f32 = 0.45;

/// The wide motion of a view; by default none.
#[derive(Debug, Clone, Default)]
pub struct Drift {
    /// Modes of the courses, the strongest first.
    modes: Vec<Mode>,
}

/// A course over the phases and the image that follows it.
#[derive(Debug, Clone)]
struct Mode {
    /// Values over the visible phases: their mean is 0, their squares sum to 1, and courses are orthogonal to each other.
    course: Vec<f32>,
    /// Line integral per pixel.
    image: Image,
    /// Mean size of the mode where it is visible, as a share of the strongest change.
    size: f32,
}

/// A course and its size, as in [`Mode`].
type Course = (Vec<f32>, f32);

impl Drift {
    /// Finds the wide motion in images whose pixels have the standard deviations `noise`.
    pub(super) fn new(series: &Series, noise: &[f32]) -> Drift {
        let images: Vec<&Image> = series.seen().collect();
        let deviations = deviations(&images);
        let (found, strongest) = courses(&deviations);
        if found.is_empty() {
            return Drift::default();
        }
        let noise: Vec<f32> = noise.iter().map(|s| s.max(MIN_NOISE_SHARE * strongest)).collect();
        let (courses, sizes): (Vec<Vec<f32>>, Vec<f32>) = found.into_iter().unzip();
        let images = Fit { deviations, courses: &courses, noise }.modes();
        let modes = courses.iter().zip(images).zip(sizes);
        Drift { modes: modes.map(|((course, image), size)| Mode { course: course.clone(), image, size }).collect() }
    }

    /// Root mean square over the phases of the largest mode where it is visible, as a share of the strongest change; `None`
    /// where there is no wide motion.
    pub fn size(&self) -> Option<f32> {
        self.modes.iter().map(|m| m.size).reduce(f32::max)
    }

    /// Returns the images without the wide motion.
    pub(super) fn stilled(&self, mut stilled: Series) -> Series {
        for (t, image) in stilled.images.iter_mut().flatten().enumerate() {
            for mode in &self.modes {
                image.values.iter_mut().zip(&mode.image.values).for_each(|(y, m)| *y -= mode.course[t] * m);
            }
        }
        stilled
    }
}

/// Images minus their median over the phases.
fn deviations(images: &[&Image]) -> Vec<Image> {
    let middle = |p: usize| median(&mut images.iter().map(|i| i.values[p]).collect::<Vec<_>>());
    let level: Vec<f32> = (0..images[0].values.len()).into_par_iter().map(middle).collect();
    let level = Image { values: level, ..*images[0] };
    images.iter().map(|image| map2(image, &level, |y, b| y - b)).collect()
}

/// Finds the courses of wide structures, and the strongest change of the narrow part.
fn courses(deviations: &[Image]) -> (Vec<Course>, f32) {
    let factor = reduction(&deviations[0]);
    let small: Vec<Image> = deviations.par_iter().map(|d| reduced(d, factor)).collect();
    let mut wide: Vec<Image> = small.par_iter().map(without_narrow).collect();
    let narrow = |p: usize| small.iter().zip(&wide).map(|(d, w)| d.values[p] - w.values[p]).fold(f32::MIN, f32::max);
    let strongest = percentile(&(0..small[0].values.len()).map(narrow).collect::<Vec<_>>(), STRONGEST_PERCENTILE);
    let mut found = Vec::new();
    if strongest <= 0.0 {
        return (found, strongest);
    }
    centre(&mut wide);
    while found.len() < MAX_COURSES.min((wide.len() - 1) / PHASES_PER_COURSE) {
        let Some(course) = strongest_course(&wide) else { break };
        let mode = mode(&wide, &course);
        let Some(size) = size_of_seen(&mode, (wide.len() as f32).sqrt() * strongest) else { break };
        let all: f32 = wide.iter().map(|w| dot(&w.values, &w.values)).sum();
        if dot(&mode.values, &mode.values) < MIN_TOLD * all {
            break;
        }
        for (image, a) in wide.iter_mut().zip(&course) {
            image.values.iter_mut().zip(&mode.values).for_each(|(w, m)| *w -= a * m);
        }
        found.push((course, size));
    }
    (found, strongest)
}

/// Mean size, in `unit`s, of a mode in the pixels where it is visible; `None` where these are too few.
fn size_of_seen(mode: &Image, unit: f32) -> Option<f32> {
    let seen: Vec<f32> = mode.values.iter().map(|m| m.abs() / unit).filter(|size| *size > MIN_SIZE).collect();
    let spread = seen.len() as f64 / mode.values.len() as f64;
    (spread >= MIN_SPREAD).then(|| seen.iter().sum::<f32>() / seen.len() as f32)
}

/// The strongest course of images whose mean over the phases is 0; `None` where all are 0.
fn strongest_course(wide: &[Image]) -> Option<Vec<f32>> {
    let gram: Vec<Vec<f32>> = wide.iter().map(|a| wide.iter().map(|b| dot(&a.values, &b.values)).collect()).collect();
    let loudest = (0..wide.len()).max_by(|a, b| gram[*a][*a].total_cmp(&gram[*b][*b]))?;
    let mut course = gram[loudest].clone();
    for _ in 0..POWER_ROUNDS {
        normalise(&mut course)?;
        course = gram.iter().map(|row| dot(row, &course)).collect();
    }
    normalise(&mut course)?;
    Some(course)
}

fn normalise(course: &mut [f32]) -> Option<()> {
    let length = dot(course, course).sqrt();
    course.iter_mut().for_each(|a| *a /= length);
    (length > 0.0).then_some(())
}

/// Projection of the images onto a course.
fn mode(images: &[Image], course: &[f32]) -> Image {
    let value = |p: usize| images.iter().zip(course).map(|(image, a)| a * image.values[p]).sum();
    Image { values: (0..images[0].values.len()).map(value).collect(), ..images[0] }
}

/// Modes of a view's images, pixel by pixel.
struct Fit<'a> {
    deviations: Vec<Image>,
    courses: &'a [Vec<f32>],
    /// Standard deviation of each pixel's noise, nowhere 0.
    noise: Vec<f32>,
}

impl Fit<'_> {
    /// Computes a mode per course: its wide part, and its narrow part weighted by the confidence in it.
    fn modes(&self) -> Vec<Image> {
        let whole = self.whole();
        let wide: Vec<Image> = whole.par_iter().map(wide_part).collect();
        let narrow: Vec<Image> = whole.iter().zip(&wide).map(|(m, w)| map2(m, w, |m, w| m - w)).collect();
        let belief = self.belief(&wide, &narrow);
        let joined = |(wide, narrow): (&Image, &Image)| {
            let believed = map2(narrow, &belief, |m, belief| belief * m);
            map2(wide, &believed, |wide, narrow| wide + narrow)
        };
        wide.iter().zip(&narrow).map(joined).collect()
    }

    /// Fits each pixel's values by the courses.
    fn whole(&self) -> Vec<Image> {
        let fit = |p: usize| {
            let values: Vec<f32> = self.deviations.iter().map(|d| d.values[p]).collect();
            followed(&values, self.courses, VESSEL_SIGMAS * self.noise[p])
        };
        let fits: Vec<Vec<f32>> = (0..self.noise.len()).into_par_iter().map(fit).collect();
        let image = |k: usize| Image { values: fits.iter().map(|f| f[k]).collect(), ..self.deviations[0] };
        (0..self.courses.len()).map(image).collect()
    }

    /// Confidence in the `narrow` parts of modes at each pixel, 0 to 1: it rises with the share that they explain, in the
    /// pixel's neighbourhood, of the residual of the `wide` parts.
    fn belief(&self, wide: &[Image], narrow: &[Image]) -> Image {
        let squares = |p: usize| self.squares_left(wide, narrow, p);
        let (before, after): (Vec<f32>, Vec<f32>) = (0..self.noise.len()).into_par_iter().map(squares).unzip();
        if !self.are_edges(&before, &after) {
            return Image::zeros(wide[0].width, wide[0].height);
        }
        let around = |values: Vec<f32>| blur(&Image { values, ..wide[0] }, TOLD_BLUR);
        let [from, to] = BELIEVED;
        map2(&around(after), &around(before), |after, before| {
            let told = 1.0 - after / before.max(f32::MIN_POSITIVE);
            ((told - from) / (to - from)).clamp(0.0, 1.0)
        })
    }

    /// Sums of squares over the phases of a pixel's residual after the wide parts, and after the narrow parts as well.
    fn squares_left(&self, wide: &[Image], narrow: &[Image], p: usize) -> (f32, f32) {
        let part = |modes: &[Image], t: usize| -> f32 {
            modes.iter().zip(self.courses).map(|(mode, course)| mode.values[p] * course[t]).sum()
        };
        let left: Vec<f32> = self.deviations.iter().enumerate().map(|(t, d)| d.values[p] - part(wide, t)).collect();
        let mean = left.iter().sum::<f32>() / left.len() as f32;
        let before = left.iter().map(|l| (l - mean).powi(2)).sum();
        let after = left.iter().enumerate().map(|(t, l)| (l - mean - part(narrow, t)).powi(2)).sum();
        (before, after)
    }

    /// Tells whether the narrow parts that follow the courses are edges of wide structures, by [`MIN_TOLD_WELL`].
    fn are_edges(&self, before: &[f32], after: &[f32]) -> bool {
        let n = self.deviations.len() as f32;
        let stands_out = |p: &usize| before[*p] > n * (STANDS_OUT_SIGMAS * self.noise[*p]).powi(2);
        let told_by = |share: f32| {
            (0..before.len()).filter(stands_out).filter(|p| after[*p] < (1.0 - share) * before[*p]).count() as f32
        };
        told_by(BELIEVED[1]) >= MIN_TOLD_WELL * told_by(0.5)
    }
}

/// Coefficients of the courses in a pixel's values, without the influence of vessels: repeated projection of the residual,
/// of which no more than `most` counts above the fit (Huber 1981, modified residuals). The start is the fit without this
/// limit.
fn followed(values: &[f32], courses: &[Vec<f32>], max: f32) -> Vec<f32> {
    let mut level = 0.0;
    let mut sizes = vec![0.0; courses.len()];
    let mut rest = vec![0.0; values.len()];
    for round in 0..=FIT_ROUNDS {
        let max = if round == 0 { f32::INFINITY } else { max };
        for (t, rest) in rest.iter_mut().enumerate() {
            let fit = level + sizes.iter().zip(courses).map(|(m, a)| m * a[t]).sum::<f32>();
            *rest = (values[t] - fit).min(max);
        }
        level += rest.iter().sum::<f32>() / rest.len() as f32;
        sizes.iter_mut().zip(courses).for_each(|(m, a)| *m += dot(a, &rest));
    }
    sizes
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Subtracts the mean over the phases.
fn centre(images: &mut [Image]) {
    let share = 1.0 / images.len() as f32;
    for p in 0..images[0].values.len() {
        let mean = images.iter().map(|i| i.values[p]).sum::<f32>() * share;
        images.iter_mut().for_each(|i| i.values[p] -= mean);
    }
}

/// Removes structures as narrow as vessels.
fn without_narrow(image: &Image) -> Image {
    median_filter(image, opening_radius(WIDE_SHARE, image.width, image.height))
}

/// Removes narrow structures in the reduced image, and enlarges the result.
fn wide_part(image: &Image) -> Image {
    let factor = reduction(image);
    enlarged(&without_narrow(&reduced(image, factor)), factor, [image.width, image.height])
}

/// Pixels along each axis that are averaged into one.
fn reduction(image: &Image) -> usize {
    (image.width.min(image.height) / SIDE).max(1)
}

/// Means of squares of `factor` pixels; remaining columns and rows at the right and bottom count in the last ones.
fn reduced(image: &Image, factor: usize) -> Image {
    let (width, height) = (image.width / factor, image.height / factor);
    let mut sums = vec![(0f32, 0u32); width * height];
    for (p, value) in image.values.iter().enumerate() {
        let [x, y] = [p % image.width / factor, p / image.width / factor];
        let sum = &mut sums[y.min(height - 1) * width + x.min(width - 1)];
        *sum = (sum.0 + value, sum.1 + 1);
    }
    Image { width, height, values: sums.into_iter().map(|(sum, n)| sum / n as f32).collect() }
}

/// Enlarges a reduced image by linear interpolation.
fn enlarged(image: &Image, factor: usize, [width, height]: [usize; 2]) -> Image {
    let place = |at: usize, end: usize| {
        let place = ((at as f32 + 0.5) / factor as f32 - 0.5).clamp(0.0, (end - 1) as f32);
        let first = (place as usize).min(end.saturating_sub(2));
        (first, (first + 1).min(end - 1), place - first as f32)
    };
    let value = |p: usize| {
        let (x, next_x, part_x) = place(p % width, image.width);
        let (y, next_y, part_y) = place(p / width, image.height);
        let row = |y: usize| {
            let at = |x: usize| image.values[y * image.width + x];
            at(x) + part_x * (at(next_x) - at(x))
        };
        row(y) + part_y * (row(next_y) - row(y))
    };
    Image { width, height, values: (0..width * height).map(value).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f32::consts::TAU;

    const SIDE: usize = 60;
    const PHASES: usize = 10;

    fn series(value: impl Fn(f32, f32, f32) -> f32) -> Series {
        series_of(PHASES, value)
    }

    fn series_of(n_phases: usize, value: impl Fn(f32, f32, f32) -> f32) -> Series {
        let image = |t: usize| {
            let at = |p: usize| value((p % SIDE) as f32, (p / SIDE) as f32, t as f32 / n_phases as f32);
            Some(Image { width: SIDE, height: SIDE, values: (0..SIDE * SIDE).map(at).collect() })
        };
        Series { view: 0, images: (0..n_phases).map(image).collect(), vessels_alone: false }
    }

    /// A vessel that moves across the image at twice the rate of breathing.
    fn vessel(x: f32, y: f32, time: f32) -> f32 {
        let middle = 30.0 + 5.0 * (2.0 * TAU * time).sin() + 0.2 * y;
        0.3 * (-0.5 * (x - middle).powi(2)).exp()
    }

    /// A dome with its edge at row 40 that moves, with all above and below it, by breathing.
    fn dome(y: f32, time: f32) -> f32 {
        let breath = (TAU * time).cos();
        1.0 / (1.0 + (-(y - 40.0 - breath) / 1.5).exp()) - 0.002 * y * breath
    }

    fn stilled(series: &Series) -> (Series, Option<f32>) {
        let drift = Drift::new(series, &vec![1e-4; SIDE * SIDE]);
        (drift.stilled(series.clone()), drift.size())
    }

    /// Mean, over the pixels about the edge, of the variation of the error over the phases.
    fn off(got: &Series, wanted: &Series) -> f32 {
        let pixel = |p: usize| {
            let error: Vec<f32> = got.seen().zip(wanted.seen()).map(|(g, w)| g.values[p] - w.values[p]).collect();
            let [low, high] = error.iter().fold([f32::MAX, f32::MIN], |[l, h], e| [l.min(*e), h.max(*e)]);
            high - low
        };
        let rows = 36..44;
        (rows.start * SIDE..rows.end * SIDE).map(pixel).sum::<f32>() / (rows.len() * SIDE) as f32
    }

    #[test]
    fn vessels_over_a_still_background_are_left_as_they_are() {
        let seen = series(|x, y, t| vessel(x, y, t) + 0.01 * y);
        let (stilled, size) = stilled(&seen);
        assert_eq!((stilled.images, size), (seen.images, None));
    }

    #[test]
    fn a_diaphragm_is_held_still_and_the_vessel_over_it_is_not() {
        let seen = series(|x, y, t| vessel(x, y, t) + dome(y, t));
        let (stilled, size) = stilled(&seen);
        assert!(size.is_some());
        let wanted = series(vessel);
        let (before, after) = (off(&seen, &wanted), off(&stilled, &wanted));
        assert!(before > 0.2 && after < 0.2 * before, "{before} of change that is none of the vessel's, {after} left");
    }

    #[test]
    fn vessels_outlast_few_phases() {
        for n_phases in 2..6 {
            let seen = series_of(n_phases, |x, y, t| vessel(x, y, t + 0.03) + dome(y, t));
            let (stilled, _) = stilled(&seen);
            let change = |of: &Series| {
                let at = |x: usize| {
                    let values = of.seen().map(|i| i.values[5 * SIDE + x]);
                    let [low, high] = values.fold([f32::MAX, f32::MIN], |[l, h], v| [l.min(v), h.max(v)]);
                    high - low
                };
                (0..SIDE).map(at).fold(0.0, f32::max)
            };
            let alone = change(&series_of(n_phases, |x, y, t| vessel(x, y, t + 0.03)));
            assert!(change(&stilled) > 0.7 * alone, "{n_phases} phases: {} of {alone}", change(&stilled));
        }
    }

    #[test]
    fn flicker_of_whole_images_is_no_motion() {
        let (_, size) = stilled(&series(|_, _, t| (TAU * t).cos()));
        assert_eq!(size, None);
    }

    #[test]
    fn enlarging_undoes_reducing_of_what_is_straight() {
        let plane =
            Image { width: 31, height: 22, values: (0..31 * 22).map(|p| (p % 31 + 2 * (p / 31)) as f32).collect() };
        let back = enlarged(&reduced(&plane, 3), 3, [31, 22]);
        for (x, y) in [(1, 1), (10, 7), (20, 14)] {
            assert!((back.values[y * 31 + x] - plane.values[y * 31 + x]).abs() < 1e-4, "{x}, {y}");
        }
    }
}
