//! Whether vessels are brighter than what surrounds them, as line integrals are, or darker, as in intensities.

use crate::calibrate::observed::binned_series;
use crate::evidence::background::{OPENING_SHARE, STRONGEST_BLUR};
use crate::evidence::series::{Series, blur, opening_radius};
use crate::raster::{Image, opening};
use crate::scan::dataset::Dataset;
use rayon::prelude::*;

/// Share of the change of narrow structures by which dark ones must exceed bright ones: narrow gaps between bright vessels are
/// dark.
const CLEARLY: f64 = 0.2;

/// Narrow parts of an image that are brighter than their surroundings, and those that are darker.
fn narrow_parts(image: &Image, radius: usize) -> [Vec<f32>; 2] {
    let image = blur(image, STRONGEST_BLUR);
    let negative = Image { values: image.values.iter().map(|v| -v).collect(), ..image.clone() };
    [image, negative].map(|image| {
        let wide = opening(&image, radius);
        image.values.iter().zip(&wide.values).map(|(v, wide)| v - wide).collect()
    })
}

/// Variance over the phases of the narrow bright and dark parts of a view, summed over its pixels. What does not move has none,
/// and how long a vessel stays at a place plays no part.
fn changes(series: &Series) -> [f64; 2] {
    let images: Vec<&Image> = series.seen().collect();
    let Some(first) = images.first() else { return [0.0; 2] };
    let radius = opening_radius(OPENING_SHARE, first.width, first.height);
    let parts: Vec<[Vec<f32>; 2]> = images.par_iter().map(|image| narrow_parts(image, radius)).collect();
    [0, 1].map(|part| {
        let variance = |pixel: usize| {
            let values = parts.iter().map(|of| f64::from(of[part][pixel]));
            let mean = values.clone().sum::<f64>() / parts.len() as f64;
            values.map(|v| (v - mean) * (v - mean)).sum::<f64>()
        };
        (0..first.values.len()).map(variance).sum()
    })
}

/// Tells whether what moves is darker than its surroundings, by a clear majority.
pub(super) fn is_inverted(dataset: &Dataset) -> bool {
    let of_views = binned_series(dataset).iter().map(changes).collect::<Vec<_>>();
    let [bright, dark] = [0, 1].map(|part| of_views.iter().map(|of| of[part]).sum::<f64>());
    dark - bright > CLEARLY * (dark + bright)
}
