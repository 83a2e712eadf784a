//! Estimates the static background anew from what a dynamic field leaves of the images: where a vessel covers a pixel at most
//! phases, the lowest phases do not show the background, but the images minus the vessels do.

use crate::evidence::series::{blur, opening_radius};
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::raster::{Image, median_filter};
use rayon::prelude::*;

/// Radius of the median that separates slow changes of the background, such as a heart's, from vessels that the field lacks, as
/// a share of the image's smaller side.
const SLOW_SHARE: f64 = 0.04;
/// Blur of the slow changes, as a share of the image's smaller side.
const SLOW_BLUR_SHARE: f64 = 0.02;
/// Line integral above the estimate that costs nothing, in standard deviations of the noise.
const FREE_NOISE: f32 = 2.0;

/// Bounds of the dynamic field's image, `[pixel]`, shares of the strongest change.
#[derive(Debug, Clone, PartialEq)]
pub struct Bounds {
    /// Index of the image.
    pub image: usize,
    /// Minimum line integral that explains the pixel.
    pub low: Vec<f32>,
    /// Maximum line integral that explains the pixel.
    pub high: Vec<f32>,
}

/// Fewest phases of a view from which its background is estimated.
pub(super) const MIN_PHASES: usize = 3;

/// Background of an image that a field leaves.
struct Background {
    image: usize,
    /// Median over the view's phases, and what changes slowly from pixel to pixel around it, shares of the strongest change.
    values: Vec<f32>,
}

/// Computes the background of each image that the field's `images` (`[image][pixel]`, shares of the strongest change) leave, one view
/// after the other, because backgrounds of large images take much memory. Views of fewer than three phases are left out.
fn backgrounds(targets: &Targets, images: &[f32]) -> impl Iterator<Item = Background> {
    let of_view = move |view: usize| -> Vec<Background> {
        let of_view: Vec<usize> =
            targets.image_of.iter().skip(view).step_by(targets.n_views).flatten().copied().collect();
        if of_view.len() < MIN_PHASES {
            return Vec::new();
        }
        let left: Vec<Image> = of_view.iter().map(|image| left(targets, images, *image)).collect();
        let level = level(&left);
        let background = |(image, left): (&usize, &Image)| {
            let slow = slow(left, &level, targets.weight.image(*image));
            Background {
                image: *image,
                values: level.iter().zip(&slow.values).map(|(level, slow)| level + slow).collect(),
            }
        };
        of_view.par_iter().zip(&left).map(background).collect()
    };
    (0..targets.n_views).flat_map(of_view)
}

/// Computes bounds from the background that the field's `images` (`[image][pixel]`, shares of the strongest change) leave, image by image
/// and one view after the other. Views of fewer than three phases are left out: they keep their bounds.
pub fn bounds(targets: &Targets, images: &[f32]) -> impl Iterator<Item = Bounds> {
    let max = targets.max.as_ref().unwrap_or(&targets.high);
    let of_image = move |Background { image, values }: Background| {
        let (contrast, noise) = (targets.contrast[image], targets.noise.image(image));
        let begin = image * targets.n_pixels();
        let low: Vec<f32> =
            values.iter().enumerate().map(|(p, b)| (targets.images[begin + p] - b) / contrast).collect();
        let high = |(p, low): (usize, &f32)| max[begin + p].min(low + FREE_NOISE * noise[p] / contrast).max(*low);
        let high = low.iter().enumerate().map(high).collect();
        Bounds { image, low, high }
    };
    backgrounds(targets, images).map(of_image)
}

/// Returns, for each image, what the field's `images` and the background leave of it, shares of the strongest change, and 0 in hidden
/// pixels; none for views of fewer than three phases.
pub(super) fn remainders(targets: &Targets, images: &[f32]) -> Vec<Option<Vec<f32>>> {
    let mut remainders = vec![None; targets.n_images];
    let n = targets.n_pixels();
    for Background { image, values } in backgrounds(targets, images) {
        let weight = targets.weight.image(image);
        let of_pixel = |(p, background): (usize, &f32)| match image * n + p {
            _ if weight[p] == 0.0 => 0.0,
            at => targets.images[at] - targets.contrast[image] * images[at] - background,
        };
        remainders[image] = Some(values.iter().enumerate().map(of_pixel).collect());
    }
    remainders
}

/// Returns an image minus the field's image at the image's contrast.
fn left(targets: &Targets, images: &[f32], image: usize) -> Image {
    let range = image * targets.n_pixels()..(image + 1) * targets.n_pixels();
    let contrast = targets.contrast[image];
    let values = targets.images[range.clone()].iter().zip(&images[range]).map(|(y, d)| y - contrast * d).collect();
    Image { width: targets.width, height: targets.height, values }
}

/// Returns the median of each pixel over the images.
pub(super) fn level(left: &[Image]) -> Vec<f32> {
    let (n, m) = (left[0].values.len(), left.len());
    let of = |p: usize| {
        let mut values: Vec<f32> = left.iter().map(|image| image.values[p]).collect();
        values.sort_unstable_by(f32::total_cmp);
        0.5 * (values[(m - 1) / 2] + values[m / 2])
    };
    (0..n).into_par_iter().map(of).collect()
}

/// Returns the changes of wide areas relative to the median. Hidden pixels, whose weight is 0, do not change.
fn slow(left: &Image, level: &[f32], weight: &[f32]) -> Image {
    let (width, height) = (left.width, left.height);
    let change = |((left, level), weight): ((&f32, &f32), &f32)| if *weight > 0.0 { left - level } else { 0.0 };
    let values = left.values.iter().zip(level).zip(weight).map(change).collect();
    let change = Image { width, height, values };
    let side = width.min(height) as f64;
    blur(&median_filter(&change, opening_radius(SLOW_SHARE, width, height)), (SLOW_BLUR_SHARE * side) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::dynamic_gaussians::targets::test_targets::{PHASES, SIDE, targets};

    /// Vessel and background of each phase: a vessel 3 pixels wide, which moves by a pixel at the first three phases, in front
    /// of a static chest; the middle of the image brightens slowly over the beat.
    fn scene() -> (Vec<f32>, Vec<f32>) {
        let (mut vessel, mut background) = (Vec::new(), Vec::new());
        for phase in 0..PHASES {
            let column = if phase < 3 { 13 } else { 12 };
            for p in 0..SIDE * SIDE {
                let (x, y) = (p % SIDE, p / SIDE);
                vessel.push(if x.abs_diff(column) <= 1 { 0.8 } else { 0.0 });
                let heart = if x.abs_diff(20).max(y.abs_diff(20)) < 14 { 0.3 * phase as f32 / 9.0 } else { 0.0 };
                background.push(2.0 + 0.5 * (p as f32 * 0.01).sin() + heart);
            }
        }
        (vessel, background)
    }

    fn error(bound: &[f32], vessel: &[f32]) -> f32 {
        bound.iter().zip(vessel).map(|(b, v)| (b - v).abs()).sum::<f32>() / vessel.len() as f32
    }

    #[test]
    fn bounds_come_closer_to_a_vessel_that_rests_at_most_phases() {
        let (vessel, background) = scene();
        let images: Vec<f32> = vessel.iter().zip(&background).map(|(v, b)| v + b).collect();
        let targets = targets(&images, 1);
        // A field that has found most of the vessel.
        let found: Vec<f32> = vessel.iter().map(|v| 0.8 * v).collect();
        let all: Vec<Bounds> = bounds(&targets, &found).collect();
        assert!(all.iter().map(|bounds| bounds.image).eq(0..PHASES), "one view, a phase after the other");
        let concat = |of: fn(&Bounds) -> &Vec<f32>| all.iter().flat_map(of).copied().collect::<Vec<f32>>();
        let (lows, highs) = (concat(|b| &b.low), concat(|b| &b.high));
        let (before, low, high) = (error(&targets.low, &vessel), error(&lows, &vessel), error(&highs, &vessel));
        println!("{before:.4} to {low:.4}, {high:.4}");
        assert!(low < 0.5 * before && high < 0.5 * before, "{before} to {low}, {high}");
        assert!(lows.iter().zip(&highs).all(|(low, high)| low <= high && high.is_finite()));
    }

    #[test]
    fn too_few_phases_say_nothing_new() {
        let (vessel, _) = scene();
        let mut targets = targets(&vessel, 1);
        targets.image_of.iter_mut().skip(2).for_each(|image| *image = None);
        assert_eq!(bounds(&targets, &vec![0.3; vessel.len()]).count(), 0);
    }

    #[test]
    fn contrast_is_no_part_of_the_background() {
        let (_, background) = scene();
        // Narrower than the window of the median, and at rest.
        let vessel: Vec<f32> = (0..background.len()).map(|p| if p % SIDE == 12 { 0.8 } else { 0.0 }).collect();
        // Odd phases have less contrast.
        let contrast: Vec<f32> = (0..PHASES).map(|t| if t % 2 == 0 { 1.2 } else { 0.8 }).collect();
        let at = |p: usize| contrast[p / (SIDE * SIDE)] * vessel[p] + background[p];
        let images: Vec<f32> = (0..vessel.len()).map(at).collect();
        // Edges of the part that brightens are no part of the slow changes.
        let inside = |p: usize| p % SIDE == 12 && (14..26).contains(&(p / SIDE));
        let largest = |contrast: Vec<f32>| {
            let targets = Targets { contrast, ..targets(&images, 1) };
            let left = remainders(&targets, &vessel);
            let pixels =
                left.iter().flatten().flat_map(|image| (0..image.len()).filter(|p| inside(*p)).map(|p| image[p]));
            pixels.fold(0f32, |max, v| max.max(v.abs()))
        };
        let (known, unknown) = (largest(contrast), largest(vec![1.0; PHASES]));
        println!("{known} {unknown}");
        assert!(unknown > 0.1 && known < 0.2 * unknown, "{known} against {unknown}");
    }

    #[test]
    fn hidden_pixels_leave_nothing() {
        let (vessel, _) = scene();
        let mut targets = targets(&vec![1.0; vessel.len()], 1);
        (0..vessel.len()).for_each(|p| targets.weight[p] = f32::from(u8::from(p % SIDE >= SIDE / 2)));
        let left = remainders(&targets, &vessel);
        let hidden = |p: usize| p % SIDE < SIDE / 2;
        let of = |image: &[f32]| (0..image.len()).filter(|p| hidden(*p)).all(|p| image[p] == 0.0);
        assert!(left.iter().flatten().all(|image| of(image)));
    }
}
