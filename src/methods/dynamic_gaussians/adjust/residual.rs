//! Residuals of the images against a field, and the misfit by which geometries are compared.

use crate::methods::dynamic_gaussians::remainder::remainders;
use crate::methods::dynamic_gaussians::targets::Targets;
use rayon::prelude::*;

// Numbers of this file: tried on real anatomy with all moderate degradations (docs/performance.md, Degradations).
/// Line integral of the field, as a share of the strongest change, above which a pixel takes part.
const ACTIVE: f32 = 0.03;
/// Distance, pixels, within which the neighbours of such a pixel take part as well.
const ACTIVE_MARGIN: usize = 3;
/// Residual, as a share of the strongest change, at which the loss turns from squares to absolute values.
const BEND: f64 = 0.05;

/// A pixel that takes part.
#[derive(Debug, Clone, Copy)]
pub(super) struct Active {
    /// Index over all images.
    pub at: usize,
    /// Factor on its squared residual.
    pub weight: f64,
    /// Part of the image that the field and the background leave, as a share of the strongest change.
    pub left: f64,
}

/// Pixels of one image that take part.
#[derive(Debug, Clone)]
pub(super) struct ActiveImage {
    /// Index of the view among those that are fitted.
    pub slot: usize,
    /// Cardiac phase.
    pub phase: usize,
    /// Mean contrast factor of the image.
    pub contrast: f64,
    /// Its pixels that take part.
    pub pixels: Vec<Active>,
}

/// Finds the pixels that take part in each image, from the field's images `drawn`, `[image][pixel]`.
pub(super) fn active_images(targets: &Targets, drawn: &[f32]) -> Vec<ActiveImage> {
    let left = remainders(targets, drawn);
    let of_image = |(at, image): (usize, &Option<usize>)| {
        let image = (*image)?;
        let left = left[image].as_ref()?;
        let begin = image * targets.n_pixels();
        let active = near(&drawn[begin..begin + targets.n_pixels()], targets.width);
        let pixel = |p: usize| {
            let (left, noise_weight) = (f64::from(left[p]), f64::from(targets.weight[begin + p]));
            let weight = noise_weight.powi(2) / (noise_weight * left).hypot(BEND);
            Active { at: begin + p, weight, left }
        };
        let pixels = (0..active.len()).filter(|p| active[*p] && targets.weight[begin + p] > 0.0).map(pixel).collect();
        let contrast = f64::from(targets.contrast[image]);
        Some(ActiveImage { slot: at % targets.n_views, phase: at / targets.n_views, contrast, pixels })
    };
    targets.image_of.par_iter().enumerate().filter_map(of_image).collect()
}

/// Marks pixels where an image exceeds [`ACTIVE`], and their neighbours within [`ACTIVE_MARGIN`] steps along rows and columns.
fn near(image: &[f32], width: usize) -> Vec<bool> {
    let mut marked: Vec<bool> = image.iter().map(|v| *v > ACTIVE).collect();
    for _ in 0..ACTIVE_MARGIN {
        let before = marked.clone();
        for (p, marked) in marked.iter_mut().enumerate() {
            let (x, n) = (p % width, before.len());
            *marked |= x > 0 && before[p - 1]
                || x + 1 < width && before[p + 1]
                || p >= width && before[p - width]
                || p + width < n && before[p + width];
        }
    }
    marked
}

/// Robust loss of a residual with a weight from noise.
fn loss(weight: f64, residual: f64) -> f64 {
    (weight * residual).hypot(BEND) - BEND
}

/// Returns the loss that a field leaves, as a share of the loss of its own images: small where it explains the images.
pub fn misfit(targets: &Targets, drawn: &[f32]) -> f64 {
    let (mut left, mut shown) = (0.0, 0.0);
    for image in active_images(targets, drawn) {
        for pixel in image.pixels {
            let weight = f64::from(targets.weight[pixel.at]);
            left += loss(weight, pixel.left);
            shown += loss(weight, image.contrast * f64::from(drawn[pixel.at]));
        }
    }
    left / shown.max(f64::MIN_POSITIVE)
}
