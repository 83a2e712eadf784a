//! Scores of a model on all unseen images, and pictures of them.

use crate::calibrate::correction::Calibration;
use crate::error::{Error, Result};
use crate::geometry::MM_PER_UNIT;
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::model::Model;
use crate::render::renderer::Renderer;
use crate::run::events::Event;
use crate::scan::dataset::{Dataset, View};
use crate::score::calibrated::{carried_by, in_calibrated_frame};
use crate::score::eval::{Evaluation, Scoring, evaluate, moving_field_warning};
use crate::score::pictures::{self, Window};
use crate::score::volume;
use std::collections::HashMap;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Options of the scoring.
pub struct ScoreOptions<'a> {
    /// Dice threshold on attenuation, 1/mm, instead of the rule.
    pub threshold_per_mm: Option<f64>,
    /// Directory for pictures: one comparison per image and one animation per view.
    pub pictures: Option<&'a Path>,
    /// Set to true to stop after the current image.
    pub cancel: &'a AtomicBool,
}

/// Returns a dataset with the geometry that a run used.
///
/// # Errors
/// [`Error::Data`] and [`Error::Io`] for a run's calibration that cannot be read or belongs to other data.
pub fn as_trained(dataset: Dataset, run: &Path) -> Result<Dataset> {
    match Calibration::read(run)? {
        Some(calibration) => dataset.corrected(&calibration),
        None => Ok(dataset),
    }
}

/// Evaluates a model on all validation frames of a dataset with the geometry of the run. Where the truth of synthetic data
/// is known, unseen views and true vessels are moved to the frame of the reconstruction, and the scores without this motion
/// are reported as well. `observe` receives [`Event::Evaluation`] after every image.
///
/// # Errors
/// [`Error::Interrupted`] after a cancel; errors of data, device and files.
pub fn evaluate_model(
    gpu: &Gpu,
    tuning: &Tuning,
    model: &Model,
    dataset: &Dataset,
    options: &ScoreOptions<'_>,
    observe: &mut dyn FnMut(&Event),
) -> Result<Evaluation> {
    if model.param_map.phases != dataset.n_phases as usize {
        return Err(Error::config(
            "dataset",
            dataset.path.display(),
            format!("has {} phases, but the run has {}", dataset.n_phases, model.param_map.phases),
        ));
    }
    let renderer = Renderer::new(gpu, model, tuning.clone())?;
    let stated = dataset;
    let carried = in_calibrated_frame(dataset)?;
    let dataset = carried.as_ref().unwrap_or(dataset);
    let frames: Vec<_> = dataset.validation().iter().collect();
    let mut beats = options.pictures.map(|directory| Beats::new(dataset, directory));
    let missing = beats.as_ref().map_or(0, |beats| beats.missing(dataset).len());
    let as_stated: Vec<_> = if carried.is_some() { stated.validation().iter().collect() } else { Vec::new() };
    let mut pace = Pace::new(frames.len() + missing + as_stated.len(), options.cancel, observe);
    let threshold = options.threshold_per_mm.map(|t| t * MM_PER_UNIT);
    let mut evaluation =
        evaluate(&renderer, dataset, &frames, model.step, threshold, |scoring| match (scoring, &mut beats) {
            (Scoring::Rendered, _) => pace.one_more(),
            (Scoring::Scored { .. }, None) => pace.check(),
            (Scoring::Scored { frame, rendering, threshold }, Some(beats)) => {
                pace.check()?;
                beats.images.insert((frame.view, frame.phase), rendering.dynamic_integral.clone());
                let path = beats.directory.join(format!("{}.png", frame.name));
                pictures::write_comparison(&path, frame, rendering, threshold, dataset.views[frame.view].size[0])
            }
        })?;
    if let Some(beats) = beats {
        beats.write(&renderer, dataset, &mut pace)?;
    }
    if carried.is_some() {
        let seen = evaluate(&renderer, stated, &as_stated, model.step, threshold, |scoring| match scoring {
            Scoring::Rendered => pace.one_more(),
            Scoring::Scored { .. } => pace.check(),
        })?;
        evaluation.dice_as_stated = Some(seen.dice);
    }
    let threshold_per_mm = evaluation.threshold.dynamic_per_mm;
    let motion = carried_by(stated)?;
    match volume::score(&renderer, &model.scene, dataset, threshold_per_mm, motion.as_ref(), || pace.check()) {
        // The truth is invalid; images are scored nevertheless.
        Err(error @ (Error::Data { .. } | Error::Io { .. })) => {
            evaluation.warnings.push(format!("There are no scores in 3D: {error}."));
        }
        scores => evaluation.volume = scores?,
    }
    evaluation.warnings.extend(moving_field_warning(&renderer, dataset)?);
    Ok(evaluation)
}

/// Counts images, reports progress, and ends the work on request.
struct Pace<'a> {
    done: usize,
    of: usize,
    begin: Instant,
    cancel: &'a AtomicBool,
    observe: &'a mut dyn FnMut(&Event),
}

impl<'a> Pace<'a> {
    fn new(of: usize, cancel: &'a AtomicBool, observe: &'a mut dyn FnMut(&Event)) -> Pace<'a> {
        let mut pace = Pace { done: 0, of, begin: Instant::now(), cancel, observe };
        pace.tell();
        pace
    }

    fn tell(&mut self) {
        let elapsed_s = self.begin.elapsed().as_secs_f64();
        let each_s = elapsed_s / self.done.max(1) as f64;
        let left_s = (self.done > 0).then(|| each_s * (self.of - self.done) as f64);
        (self.observe)(&Event::Evaluation { images: self.done, of: self.of, elapsed_s, left_s });
    }

    fn one_more(&mut self) -> Result<()> {
        self.done += 1;
        self.tell();
        self.check()
    }

    fn check(&self) -> Result<()> {
        if self.cancel.load(Ordering::Relaxed) { Err(Error::Interrupted) } else { Ok(()) }
    }
}

/// Animations of the dynamic field, one per validation view.
struct Beats<'a> {
    directory: &'a Path,
    views: Vec<usize>,
    /// Line integrals of the views and phases rendered so far.
    images: HashMap<(usize, u32), Vec<f32>>,
}

impl<'a> Beats<'a> {
    fn new(dataset: &Dataset, directory: &'a Path) -> Beats<'a> {
        let mut views: Vec<usize> = dataset.validation().iter().map(|f| f.view).collect();
        views.sort_unstable();
        views.dedup();
        Beats { directory, views, images: HashMap::new() }
    }

    /// Views and phases without a validation frame.
    fn missing(&self, dataset: &Dataset) -> Vec<(usize, u32)> {
        let n_phases = dataset.shown_phases();
        let every = self.views.iter().flat_map(|view| (0..n_phases).map(move |phase| (*view, phase)));
        let seen = |at: &(usize, u32)| dataset.validation().iter().any(|f| (f.view, f.phase) == *at);
        every.filter(|at| !seen(at)).collect()
    }

    fn write(mut self, renderer: &Renderer, dataset: &Dataset, pace: &mut Pace<'_>) -> Result<()> {
        for (view, phase) in self.missing(dataset) {
            let View { rays, size: [width, height], .. } = &dataset.views[view];
            let seen = renderer.render(rays, *width, *height, phase)?;
            self.images.insert((view, phase), seen.dynamic_integral);
            pace.one_more()?;
        }
        for (index, view) in self.views.iter().enumerate() {
            let beat: Vec<Vec<f32>> =
                (0..dataset.shown_phases()).filter_map(|p| self.images.remove(&(*view, p))).collect();
            let high = beat.iter().flatten().copied().fold(f32::MIN_POSITIVE, f32::max);
            let path = self.directory.join(format!("beat-view{index}.gif"));
            pictures::write_gif(&path, &beat, dataset.views[*view].size[0], Window { low: 0.0, high: 0.8 * high }, 90)?;
            pace.check()?;
        }
        Ok(())
    }
}
