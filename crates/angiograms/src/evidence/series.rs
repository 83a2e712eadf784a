//! Images of a view over the beat, and the filters that background and drift share.

use crate::evidence::filters::{gaussian, separable};
use crate::raster::Image;
use crate::scan::dataset::Dataset;

/// Minimum noise, as a share of the strongest change: models have errors, too.
pub(super) const MIN_NOISE_SHARE: f32 = 0.01;
/// Percentile of the changes that counts as the strongest change.
pub(super) const STRONGEST_PERCENTILE: f64 = 0.995;
/// Minimum radius of an opening, pixels.
const MIN_OPENING_RADIUS: usize = 2;

/// Line integrals of one training view over the beat.
#[derive(Debug, Clone)]
pub struct Series {
    /// Index into [`Dataset::views`].
    pub view: usize,
    /// An image per phase of the dataset, as large as the view's; `None` where the view has none.
    pub images: Vec<Option<Image>>,
    /// Whether the images show vessels and nothing else.
    pub vessels_alone: bool,
}

impl Series {
    /// Returns the training images of each view that has at least two phases; several images of one phase are averaged.
    pub fn of(dataset: &Dataset) -> Vec<Series> {
        Series::each(dataset).collect()
    }

    /// Returns the same as [`Series::of`], one view after the other.
    pub fn each(dataset: &Dataset) -> impl Iterator<Item = Series> {
        Series::views(dataset).into_iter().map(|view| Series::of_view(dataset, view))
    }

    /// Returns the training views that have at least two phases.
    pub fn views(dataset: &Dataset) -> Vec<usize> {
        let phases = |view: usize| {
            let mut phases: Vec<u32> = dataset.training().iter().filter(|f| f.view == view).map(|f| f.phase).collect();
            phases.sort_unstable();
            phases.dedup();
            phases.len()
        };
        dataset.training_views().into_iter().filter(|view| phases(*view) > 1).collect()
    }

    /// Returns the training images of a view.
    pub fn of_view(dataset: &Dataset, view: usize) -> Series {
        let images = (0..dataset.n_phases).map(|phase| mean_image(dataset, view, phase)).collect();
        Series { view, images, vessels_alone: dataset.vessels_alone }
    }

    /// Images of the phases the view has.
    pub fn seen(&self) -> impl Iterator<Item = &Image> {
        self.images.iter().flatten()
    }
}

fn mean_image(dataset: &Dataset, view: usize, phase: u32) -> Option<Image> {
    let frames: Vec<_> = dataset.training().iter().filter(|f| f.view == view && f.phase == phase).collect();
    if frames.is_empty() {
        return None;
    }
    let scale = 1.0 / frames.len() as f32;
    let images: Vec<_> = frames.iter().map(|f| dataset.own(view, &f.integrals)).collect();
    let [width, height] = dataset.views[view].size;
    let value = |p: usize| images.iter().map(|image| image[p]).sum::<f32>() * scale;
    Some(Image { width, height, values: (0..width * height).map(value).collect() })
}

/// Radius of an opening, from its share of an image's smaller side.
pub fn opening_radius(share: f64, width: usize, height: usize) -> usize {
    ((share * width.min(height) as f64).round() as usize).max(MIN_OPENING_RADIUS)
}

/// Gaussian blur; outside, the border's pixels are continued.
pub fn blur(image: &Image, sigma: f32) -> Image {
    separable(image, &gaussian(sigma))
}
