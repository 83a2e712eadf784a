//! What a finished run is worth: scores on every unseen image, pictures of them, and a page to look at.

use crate::data::dataset::Dataset;
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::kernels::Tuning;
use crate::model::field::Model;
use crate::output::eval::{Evaluation, evaluate};
use crate::output::page::Page;
use crate::output::pictures::{self, Window};
use crate::output::render::Renderer;
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
            "--data",
            dataset.path.display(),
            format!("has {} phases, the run {}", dataset.n_phases, model.layout.phases),
        ));
    }
    let renderer = Renderer::new(gpu, model, tuning.clone())?;
    let frames: Vec<_> = dataset.validation().iter().collect();
    let threshold = threshold_per_mm.map(|t| t * crate::data::geometry::MM_PER_UNIT);
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

/// Writes `report.html` for a model: its scores with the pictures [`evaluate_model`] left in `pictures`, and, where `run`
/// is a run directory, how it came about.
///
/// # Errors
/// [`Error::Io`].
pub fn write_page(
    gpu: &Gpu,
    tuning: &Tuning,
    model: &Model,
    dataset: &Dataset,
    evaluation: Option<&Evaluation>,
    (run, pictures): (&Path, &Path),
    path: &Path,
) -> Result<()> {
    let log = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default();
    let metrics: Vec<serde_json::Value> = log.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let latest = |event: &str| metrics.iter().rev().find(|line| line["event"] == event);
    let mut facts = vec![
        ("dataset".to_owned(), dataset.path.display().to_string()),
        ("images".to_owned(), images_of(dataset)),
        ("iterations".to_owned(), format!("{} of {}", model.step, model.config.train.iterations)),
        ("parameters".to_owned(), model.layout.len.to_string()),
        ("preset".to_owned(), model.config.preset.name().to_owned()),
        (
            "hull".to_owned(),
            model.hull.as_ref().map_or("none".into(), |h| format!("{:.3} % of the box", 100.0 * h.share())),
        ),
        ("scored on".to_owned(), gpu.info().name.clone()),
        ("commit".to_owned(), env!("NERTCA_COMMIT").to_owned()),
    ];
    if let Some(started) = latest("started") {
        facts.push(("trained on".into(), started["device"].as_str().unwrap_or_default().to_owned()));
        let notes = started["notes"].as_array().into_iter().flatten().filter_map(|n| n.as_str());
        facts.extend(notes.map(|note| ("note".to_owned(), note.to_owned())));
    } else {
        facts.extend(tuning.reasons.iter().map(|reason| ("note".to_owned(), reason.clone())));
    }
    if let Some(s) = latest("finished").and_then(|line| line["train_s"].as_f64()) {
        facts.push(("training".into(), format!("{s:.1} s; the paper: 2220 s of an RTX A5000")));
    }
    let frames = dataset.validation().iter();
    let page = Page {
        title: run.file_name().map_or("run".into(), |name| name.to_string_lossy().into_owned()),
        facts,
        warnings: warnings(model, dataset, evaluation),
        metrics,
        evaluation,
        pictures: frames
            .map(|f| (f.view, f.phase, pictures.join(format!("{}.png", f.name))))
            .filter(|(_, _, file)| file.is_file())
            .collect(),
        config: model.config.to_toml()?,
    };
    page.write(path)
}

fn images_of(dataset: &Dataset) -> String {
    format!(
        "{} x {}, {} to train on from {} views, {} to score with, {} phases",
        dataset.width,
        dataset.height,
        dataset.training().len(),
        dataset.training_views().len(),
        dataset.validation().len(),
        dataset.n_phases
    )
}

fn warnings(model: &Model, dataset: &Dataset, evaluation: Option<&Evaluation>) -> Vec<String> {
    let mut warnings = Vec::new();
    if model.step < model.config.train.iterations {
        warnings.push(format!("Not finished: {} of {} iterations.", model.step, model.config.train.iterations));
    }
    if model.config.hull.enabled && model.hull.is_none() {
        warnings.push("No motion hull was used: views may not agree, or too much moves.".to_owned());
    }
    if let Some(hull) = model.hull.as_ref().filter(|h| h.share() < 5e-5) {
        warnings.push(format!(
            "The motion hull keeps {:.4} % of the box: views hardly agree. Check geometry and phases, or raise \
             hull.dilate_pixels.",
            100.0 * hull.share()
        ));
    }
    if evaluation.is_none() {
        warnings.push("The dataset has no validation frames: nothing was scored.".to_owned());
    } else if dataset.validation().iter().all(|f| f.mask.is_none()) {
        warnings.push("The validation frames have no vessel masks: there is no Dice.".to_owned());
    }
    warnings
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
