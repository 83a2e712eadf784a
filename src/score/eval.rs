//! Evaluation on views the reconstruction has not seen (method, section 5).

use crate::error::{Error, Result};
use crate::render::renderer::{Renderer, Rendering};
use crate::scan::dataset::{Dataset, Frame};
use crate::score::metrics;
use serde::Serialize;

/// Metrics of one image.
#[derive(Debug, Clone, Serialize)]
pub struct ImageScore {
    /// Name of the frame.
    pub name: String,
    /// Primary angle in degrees, where known.
    pub primary_deg: Option<f64>,
    /// Secondary angle in degrees, where known.
    pub secondary_deg: Option<f64>,
    /// Cardiac phase.
    pub phase: u32,
    /// Dice of the dynamic field; none without a mask.
    pub dice_dynamic: Option<f64>,
    /// Dice of both fields.
    pub dice_total: Option<f64>,
    /// dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
}

/// Means over images with a mask.
#[derive(Debug, Clone, Serialize)]
pub struct DiceMeans {
    /// Dynamic field (paper).
    pub dynamic: Option<f64>,
    /// Both fields (authors' code).
    pub total: Option<f64>,
}

/// Where predicted attenuation counts as vessel.
#[derive(Debug, Clone, Serialize)]
pub struct Thresholds {
    /// For the dynamic field, per mm.
    pub dynamic_per_mm: f64,
    /// For both fields, per mm.
    pub total_per_mm: f64,
    /// How they were chosen.
    pub rule: &'static str,
}

/// The outcome.
#[derive(Debug, Clone, Serialize)]
pub struct Evaluation {
    /// Iterations of the model.
    pub step: u32,
    /// Mean Dice.
    pub dice: DiceMeans,
    /// Mean PSNR, dB.
    pub psnr: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Thresholds used.
    pub threshold: Thresholds,
    /// One row per image.
    pub images: Vec<ImageScore>,
}

/// Threshold on attenuation per world unit for a set of maximum projections.
fn choose_thresholds(seen: &[Rendering], stated: Option<f64>, given: Option<f64>) -> (f64, f64, &'static str) {
    match (given, stated) {
        (Some(t), _) => (t, t, "given"),
        (None, Some(vessel)) => (vessel / 3.0, vessel / 3.0, "a third of the stated vessel attenuation"),
        (None, None) => {
            let all = |pick: fn(&Rendering) -> &Vec<f32>| {
                f64::from(metrics::otsu(&seen.iter().flat_map(|r| pick(r).iter().copied()).collect::<Vec<_>>()))
            };
            (all(|r| &r.dynamic_max), all(|r| &r.total_max), "Otsu on the predicted maximum projections")
        }
    }
}

/// Scores frames of a dataset. `threshold` (per world unit) overrides the rule; `look` gets every frame
/// with its rendering and the dynamic threshold.
///
/// # Errors
/// [`Error::Data`] without frames; device errors; errors of `look`.
pub fn evaluate(
    renderer: &Renderer,
    dataset: &Dataset,
    frames: &[&Frame],
    step: u32,
    threshold: Option<f64>,
    mut look: impl FnMut(&Frame, &Rendering, f64) -> Result<()>,
) -> Result<Evaluation> {
    if frames.is_empty() {
        return Err(Error::data(&dataset.path, "frames", "none is for validation"));
    }
    let seen = frames
        .iter()
        .map(|f| renderer.render(&dataset.views[f.view].rays, dataset.width, dataset.height, f.phase))
        .collect::<Result<Vec<_>>>()?;
    let (dynamic_threshold, total_threshold, rule) = choose_thresholds(&seen, dataset.vessel_attenuation, threshold);
    let mut images = Vec::new();
    for (frame, rendering) in frames.iter().zip(&seen) {
        look(frame, rendering, dynamic_threshold)?;
        let overlap = |values: &[f32], threshold: f64| {
            let mask = frame.mask.as_ref()?;
            let predicted: Vec<bool> = values.iter().map(|v| f64::from(*v) > threshold).collect();
            Some(metrics::dice(&predicted, mask))
        };
        let (truth, prediction) = metrics::normalised(&frame.integrals, &rendering.total_integral());
        let angles = dataset.views[frame.view].geometry.angles_deg();
        images.push(ImageScore {
            name: frame.name.clone(),
            primary_deg: angles.map(|a| a.0),
            secondary_deg: angles.map(|a| a.1),
            phase: frame.phase,
            dice_dynamic: overlap(&rendering.dynamic_max, dynamic_threshold),
            dice_total: overlap(&rendering.total_max, total_threshold),
            psnr: metrics::psnr(&truth, &prediction),
            ssim: metrics::ssim(&truth, &prediction, dataset.width),
        });
    }
    let mean = |pick: &dyn Fn(&ImageScore) -> Option<f64>| {
        let values: Vec<f64> = images.iter().filter_map(pick).collect();
        (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
    };
    let per_mm = |t: f64| t / crate::geometry::MM_PER_UNIT;
    Ok(Evaluation {
        step,
        dice: DiceMeans { dynamic: mean(&|i| i.dice_dynamic), total: mean(&|i| i.dice_total) },
        psnr: mean(&|i| Some(i.psnr)).unwrap_or(f64::NAN),
        ssim: mean(&|i| Some(i.ssim)).unwrap_or(f64::NAN),
        threshold: Thresholds {
            dynamic_per_mm: per_mm(dynamic_threshold),
            total_per_mm: per_mm(total_threshold),
            rule,
        },
        images,
    })
}

/// `n` of the dataset's validation frames, evenly spread.
pub fn spread_validation(dataset: &Dataset, n: usize) -> Vec<&Frame> {
    let all = dataset.validation();
    let n = n.min(all.len());
    let mut picked: Vec<usize> = (0..n).map(|i| ((i as f64 + 0.5) * all.len() as f64 / n as f64) as usize).collect();
    picked.dedup();
    picked.into_iter().map(|i| &all[i]).collect()
}
