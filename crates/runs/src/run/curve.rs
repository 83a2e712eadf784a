//! Images of the curve that validation draws during training, at a bounded cost.

use crate::config::Config;
use crate::scan::dataset::{Dataset, Frame, View};

/// Validation images used during training; evenly spread over all of them.
pub(super) const VALIDATION_IMAGES: usize = 8;
/// Largest share of a network's evaluations in training that validation may add.
const LARGEST_SHARE: f64 = 0.1;
/// Evaluations of a sample in an iteration: forward once, backward for weights and inputs.
const PASSES_OF_TRAINING: f64 = 3.0;
/// Least number of pixels along each side of an image, for the windows of SSIM.
const LEAST_SIDE: usize = 32;

/// Returns the step between the pixels that validation uses along columns and rows: 1 unless a network that no hull confines would be
/// evaluated for all pixels more often than training allows.
pub(super) fn validation_step(config: &Config, dataset: &Dataset) -> usize {
    let every = config.train.validate_every;
    let unconfined = config.fields().filter(|settings| settings.network.is_some() && !settings.has_hull);
    let Some(settings) = unconfined.filter(|_| every > 0) else { return 1 };
    let images = dataset.validation().len().min(VALIDATION_IMAGES);
    let validation = (images * dataset.n_pixels()) as f64 * f64::from(settings.render_samples);
    let samples = f64::from(every) * f64::from(settings.rays) * f64::from(settings.march.dynamic_samples);
    let step = (validation / (LARGEST_SHARE * PASSES_OF_TRAINING * samples)).sqrt().ceil();
    let most = (dataset.width.min(dataset.height) / LEAST_SIDE).max(1);
    (step as usize).clamp(1, most)
}

/// Returns the validation frames of a dataset with every `step`-th of their pixels along columns and rows.
pub(super) fn thinned(dataset: &Dataset, step: usize) -> Dataset {
    let (width, height) = (dataset.width.div_ceil(step), dataset.height.div_ceil(step));
    let pixel = |i: usize| (i / width) * step * dataset.width + (i % width) * step;
    let mask = |values: &[bool]| -> Vec<bool> { (0..width * height).map(|i| values[pixel(i)]).collect() };
    let frame = |f: &Frame| Frame {
        integrals: (0..width * height).map(|i| f.integrals[pixel(i)]).collect::<Vec<f32>>().into(),
        mask: f.mask.as_deref().map(mask),
        ..f.clone()
    };
    let view = |v: &View| View {
        geometry: v.geometry.clone(),
        size: v.size.map(|n| n.div_ceil(step)),
        rays: v.rays.every(step),
    };
    Dataset {
        frames: dataset.validation().iter().map(frame).collect(),
        views: dataset.views.iter().map(view).collect(),
        hidden: dataset.hidden.iter().map(|(view, hidden)| (*view, mask(hidden))).collect(),
        path: dataset.path.clone(),
        notes: Vec::new(),
        prior: None,
        width,
        height,
        ..*dataset
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;
    use crate::scan::small::uneven_dataset;

    #[test]
    fn only_thin_batches_of_unconfined_networks_validate_fewer_pixels() {
        let dataset = uneven_dataset(200, 200).unwrap();
        let step = |preset: Preset, settings: &[&str]| {
            let settings: Vec<String> = settings.iter().map(|s| (*s).to_owned()).collect();
            validation_step(&Config::load(Some(preset), None, &settings).unwrap(), &dataset)
        };
        assert_eq!([step(Preset::Paper, &[]), step(Preset::FastMlp, &[]), step(Preset::Fast, &[])], [1, 1, 1]);
        let thin = ["train.rays=64", "march.dynamic_samples=48", "march.static_samples=48"];
        assert!(step(Preset::Paper, &thin) > 2);
        assert_eq!(step(Preset::Paper, &[&thin[..], &["train.validate_every=0"]].concat()), 1);
    }

    #[test]
    fn thinned_frames_keep_pixels_and_their_rays() {
        let dataset = uneven_dataset(20, 14).unwrap();
        let thin = thinned(&dataset, 3);
        assert_eq!((thin.width, thin.height, thin.frames.len()), (7, 5, dataset.validation().len()));
        let (fine, coarse) = (&dataset.validation()[0], &thin.frames[0]);
        for (column, row) in [(0, 0), (6, 4), (2, 3)] {
            assert_eq!(coarse.integrals[row * 7 + column], fine.integrals[3 * row * 20 + 3 * column]);
            let at = |d: &Dataset, i: usize, j: usize| d.views[fine.view].rays.pixel(i as f64, j as f64);
            let ((a, b), (c, d)) = (at(&dataset, 3 * column, 3 * row), at(&thin, column, row));
            assert!((a - c).length() < 1e-12 && (b - d).length() < 1e-12);
        }
    }
}
