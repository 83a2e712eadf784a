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

/// Bounds of the dynamic field's images, `[image][pixel]`, shares of the strongest change.
#[derive(Debug, Clone, PartialEq)]
pub struct Bounds {
    /// Minimum line integral that explains the pixel.
    pub low: Vec<f32>,
    /// Maximum line integral that explains the pixel.
    pub high: Vec<f32>,
}

/// Computes bounds from the background that the field's `images` (`[image][pixel]`, shares of the strongest change) leave: the
/// median over a view's phases, and what changes slowly from pixel to pixel around it. Views of fewer than three phases keep
/// their `bounds`.
pub fn bounds(targets: &Targets, images: &[f32], mut bounds: Bounds) -> Bounds {
    let n = targets.n_pixels();
    for view in 0..targets.n_views {
        let of_view: Vec<usize> =
            targets.image_of.iter().skip(view).step_by(targets.n_views).flatten().copied().collect();
        if of_view.len() < 3 {
            continue;
        }
        let left: Vec<Image> = of_view.iter().map(|image| left(targets, images, *image)).collect();
        let level = level(&left);
        let slow: Vec<Image> = left.par_iter().map(|left| slow(left, &level)).collect();
        for (image, slow) in of_view.into_iter().zip(&slow) {
            for (p, (level, slow)) in level.iter().zip(&slow.values).enumerate() {
                let at = image * n + p;
                let low = targets.images[at] - level - slow;
                bounds.low[at] = low;
                bounds.high[at] = targets.max[at].min(low + FREE_NOISE * targets.noise[at]).max(low);
            }
        }
    }
    bounds
}

/// Returns an image minus the field's image.
fn left(targets: &Targets, images: &[f32], image: usize) -> Image {
    let range = image * targets.n_pixels()..(image + 1) * targets.n_pixels();
    let values = targets.images[range.clone()].iter().zip(&images[range]).map(|(y, d)| y - d).collect();
    Image { width: targets.width, height: targets.height, values }
}

/// Returns the median of each pixel over the images.
fn level(left: &[Image]) -> Vec<f32> {
    let (n, m) = (left[0].values.len(), left.len());
    let of = |p: usize| {
        let mut values: Vec<f32> = left.iter().map(|image| image.values[p]).collect();
        values.sort_unstable_by(f32::total_cmp);
        0.5 * (values[(m - 1) / 2] + values[m / 2])
    };
    (0..n).into_par_iter().map(of).collect()
}

/// Returns the changes of wide areas relative to the median.
fn slow(left: &Image, level: &[f32]) -> Image {
    let (width, height) = (left.width, left.height);
    let values = left.values.iter().zip(level).map(|(left, level)| left - level).collect();
    let change = Image { width, height, values };
    let side = width.min(height) as f64;
    blur(&median_filter(&change, opening_radius(SLOW_SHARE, width, height)), (SLOW_BLUR_SHARE * side) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gaussians::field::Units;
    use crate::gaussians::view::SplatView;
    use crate::geometry::{CArm, Geometry};
    use crate::methods::dynamic_gaussians::lengths::Lengths;

    const SIDE: usize = 40;
    const PHASES: usize = 10;

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

    /// Targets from the minimum of each pixel over the phases.
    fn targets(images: &[f32]) -> Targets {
        let geometry = CArm {
            primary_deg: 0.0,
            secondary_deg: 0.0,
            sid_mm: 1000.0,
            sod_mm: 700.0,
            pixel_mm: [1.0; 2],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        };
        let units = Units { pixel: 0.01, strongest: 1.0 };
        let n = SIDE * SIDE;
        let min = |p: usize| (0..PHASES).map(|t| images[t * n + p % n]).fold(f32::MAX, f32::min);
        let low: Vec<f32> = (0..images.len()).map(|p| images[p] - min(p)).collect();
        Targets {
            units,
            width: SIDE,
            height: SIDE,
            n_phases: PHASES,
            n_views: 1,
            views: vec![SplatView::new(&Geometry::CArm(geometry).rays(SIDE, SIDE).unwrap(), units); PHASES],
            image_of: (0..PHASES).map(Some).collect(),
            n_images: PHASES,
            images: images.to_vec(),
            max: low.iter().map(|v| v + 1.0).collect(),
            high: low.iter().map(|v| v + 1.0).collect(),
            weight: vec![1.0; low.len()],
            noise: vec![0.01; low.len()],
            low,
            lengths: Lengths { factor: 1.0, smoothing: 1.0 },
            rest_phase: 0,
            places: vec![Vec::new(); PHASES],
            cell: 1.0,
        }
    }

    fn before_it(targets: &Targets) -> Bounds {
        Bounds { low: targets.low.clone(), high: targets.high.clone() }
    }

    fn error(bound: &[f32], vessel: &[f32]) -> f32 {
        bound.iter().zip(vessel).map(|(b, v)| (b - v).abs()).sum::<f32>() / vessel.len() as f32
    }

    #[test]
    fn bounds_come_closer_to_a_vessel_that_rests_at_most_phases() {
        let (vessel, background) = scene();
        let images: Vec<f32> = vessel.iter().zip(&background).map(|(v, b)| v + b).collect();
        let targets = targets(&images);
        // A field that has found most of the vessel.
        let found: Vec<f32> = vessel.iter().map(|v| 0.8 * v).collect();
        let bounds = bounds(&targets, &found, before_it(&targets));
        let (before, low, high) =
            (error(&targets.low, &vessel), error(&bounds.low, &vessel), error(&bounds.high, &vessel));
        println!("{before:.4} to {low:.4}, {high:.4}");
        assert!(low < 0.5 * before && high < 0.5 * before, "{before} to {low}, {high}");
        assert!(bounds.low.iter().zip(&bounds.high).all(|(low, high)| low <= high && high.is_finite()));
    }

    #[test]
    fn too_few_phases_say_nothing_new() {
        let (vessel, _) = scene();
        let mut targets = targets(&vessel);
        targets.image_of.iter_mut().skip(2).for_each(|image| *image = None);
        let bounds = bounds(&targets, &vec![0.3; vessel.len()], before_it(&targets));
        assert_eq!((bounds.low, bounds.high), (targets.low, targets.high));
    }
}
