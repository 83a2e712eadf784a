//! Scores of a model on every unseen image, and pictures of them.

use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::model::Model;
use crate::render::renderer::Renderer;
use crate::scan::dataset::Dataset;
use crate::score::eval::{Evaluation, evaluate};
use crate::score::pictures::{self, Window};
use std::path::Path;

/// Evaluates a model on all validation frames and leaves pictures in `directory`, if given: one comparison per
/// frame and one animation per view.
///
/// # Errors
/// Errors of data, device and files.
pub fn evaluate_model(
    gpu: &Gpu,
    tuning: &Tuning,
    model: &Model,
    dataset: &Dataset,
    threshold_per_mm: Option<f64>,
    directory: Option<&Path>,
) -> Result<Evaluation> {
    if model.layout.phases != dataset.n_phases as usize {
        return Err(Error::config(
            "dataset",
            dataset.path.display(),
            format!("has {} phases, the run {}", dataset.n_phases, model.layout.phases),
        ));
    }
    let renderer = Renderer::new(gpu, model, tuning.clone())?;
    let frames: Vec<_> = dataset.validation().iter().collect();
    let threshold = threshold_per_mm.map(|t| t * crate::geometry::MM_PER_UNIT);
    let evaluation = evaluate(&renderer, dataset, &frames, model.step, threshold, |frame, seen, threshold| {
        let Some(directory) = directory else { return Ok(()) };
        pictures::write_comparison(
            &directory.join(format!("{}.png", frame.name)),
            frame,
            seen,
            threshold,
            dataset.width,
        )
    })?;
    if let Some(directory) = directory {
        write_beats(&renderer, dataset, directory)?;
    }
    Ok(evaluation)
}

/// One animation of the dynamic field per validation view.
fn write_beats(renderer: &Renderer, dataset: &Dataset, directory: &Path) -> Result<()> {
    let mut views: Vec<usize> = dataset.validation().iter().map(|f| f.view).collect();
    views.sort_unstable();
    views.dedup();
    for (index, view) in views.into_iter().enumerate() {
        let beat = (0..dataset.n_phases)
            .map(|phase| {
                let rays = &dataset.views[view].rays;
                Ok(renderer.render(rays, dataset.width, dataset.height, phase)?.dynamic_integral)
            })
            .collect::<Result<Vec<_>>>()?;
        let high = beat.iter().flatten().copied().fold(f32::MIN_POSITIVE, f32::max);
        let path = directory.join(format!("beat-view{index}.gif"));
        pictures::write_gif(&path, &beat, dataset.width, Window { low: 0.0, high: 0.8 * high }, 90)?;
    }
    Ok(())
}
