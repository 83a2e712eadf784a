//! Evaluation on views that the reconstruction was not trained on (method, section 5).

use crate::error::{Error, Result};
use crate::geometry::MM_PER_UNIT;
use crate::raster::percentile;
use crate::render::renderer::{Renderer, Rendering};
use crate::scan::dataset::{Dataset, Frame};
use crate::score::ceiling::TruthDice;
use crate::score::dice::{BestDice, mean, overlap};
use crate::score::metrics;
use crate::score::trees::TreeScores;
use crate::score::volume::VolumeScores;
use crate::vessels::threshold::{self, PUBLISHED_THRESHOLD, VESSEL_SHARE};
use serde::Serialize;
use std::borrow::Cow;

/// Description of the Dice threshold for X-Gaussian, whose opacities are no attenuation.
const OPACITY_RULE: &str = "the published threshold of 0.05 on the sum of opacities";
/// Description of the Dice threshold where no attenuation is stated.
const VESSEL_RULE: &str =
    "a fifth of the strongest predicted attenuation, the 99.5th percentile of the maximum projections";
/// Share of an image's pixels whose change may exceed the one that counts as its strongest.
const STRONGEST: f64 = 0.005;
/// A dynamic field whose line integrals stay below this share of the strongest change in the data has vanished.
const DEAD_SHARE: f64 = 0.1;

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
    /// Dice of the dynamic field; `None` without a mask.
    pub dice_dynamic: Option<f64>,
    /// Dice of the sum of both fields.
    pub dice_total: Option<f64>,
    /// Dice of X-Gaussian at Otsu's threshold of this image; `None` for other methods.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dice_otsu: Option<f64>,
    /// Peak signal-to-noise ratio, dB.
    pub psnr: f64,
    /// Structural similarity.
    pub ssim: f64,
}

/// Means over images with a mask.
#[derive(Debug, Clone, Serialize)]
pub struct DiceMeans {
    /// Mean of the dynamic field, as in the paper.
    pub dynamic: Option<f64>,
    /// Mean of the sum of both fields, as in the authors' code.
    pub total: Option<f64>,
}

/// Dice at the fixed threshold of the authors' public code, for comparison with their published values.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PublishedDice {
    /// The threshold, per mm.
    pub threshold_per_mm: f64,
    /// Mean Dice of the dynamic field over images with a mask, as the paper states.
    pub paper: Option<f64>,
    /// Dice of the sum of both fields in the first image alone, as the authors' code computes it.
    pub authors: Option<f64>,
}

/// Thresholds above which predicted attenuation counts as vessel.
#[derive(Debug, Clone, Serialize)]
pub struct Thresholds {
    /// Threshold of the dynamic field, per mm.
    pub dynamic_per_mm: f64,
    /// Threshold of the sum of both fields, per mm.
    pub total_per_mm: f64,
    /// Rule by which the thresholds were chosen.
    pub rule: &'static str,
}

/// Best Dice over thresholds; `None` without masks.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct BestDices {
    /// Best Dice of the dynamic field.
    pub dynamic: Option<BestDice>,
    /// Best Dice of the sum of both fields.
    pub total: Option<BestDice>,
}

/// Result of an evaluation.
#[derive(Debug, Clone, Serialize)]
pub struct Evaluation {
    /// Iterations of the model.
    pub step: u32,
    /// Mean Dice.
    pub dice: DiceMeans,
    /// Dice without the motion of the calibrated reconstruction, where that motion was applied to unseen views of synthetic
    /// data.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dice_as_stated: Option<DiceMeans>,
    /// Dice at the best threshold.
    pub best_dice: BestDices,
    /// Dice by the definitions of the paper and of the authors' code.
    pub dice_published: PublishedDice,
    /// Mean Dice of X-Gaussian at Otsu's threshold of each image's own maximum sums of opacities, since these have no
    /// scale; `None` for other methods.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dice_otsu: Option<f64>,
    /// Mean PSNR, dB.
    pub psnr: f64,
    /// Mean SSIM.
    pub ssim: f64,
    /// Thresholds used.
    pub threshold: Thresholds,
    /// Score of the true vessels on the same images, where it was requested and the dataset has them as volumes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ceiling: Option<TruthDice>,
    /// Scores in 3D, where the dataset has its vessels as volumes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub volume: Option<VolumeScores>,
    /// Scores of the vessels as a tree, where one was made and the dataset has the true one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tree: Option<TreeScores>,
    /// Reasons why these scores may be unreliable.
    pub warnings: Vec<String>,
    /// One row per image.
    pub images: Vec<ImageScore>,
}

/// Events of scoring in progress.
pub enum Scoring<'a> {
    /// An image has been rendered.
    Rendered,
    /// An image is scored.
    Scored {
        /// The image, in the size of its view.
        frame: &'a Frame,
        /// The model's rendering of the frame.
        rendering: &'a Rendering,
        /// Threshold on the dynamic field, per world unit.
        threshold: f64,
    },
}

/// Selects the quantity of a rendering that is compared with the mask.
type Maxima = fn(&Rendering) -> &[f32];

const DYNAMIC: Maxima = |r| &r.dynamic_max;
const TOTAL: Maxima = |r| &r.total_max;

/// Chooses the thresholds on attenuation per world unit for a set of maximum projections; `blended` ones are of opacities.
fn choose_thresholds(
    seen: &[Rendering],
    stated: Option<f64>,
    given: Option<f64>,
    blended: bool,
) -> (f64, f64, &'static str) {
    match (given, stated) {
        (Some(t), _) => (t, t, "given"),
        _ if blended => (PUBLISHED_THRESHOLD, PUBLISHED_THRESHOLD, OPACITY_RULE),
        (None, Some(vessel)) => {
            (VESSEL_SHARE * vessel, VESSEL_SHARE * vessel, "a fifth of the stated vessel attenuation")
        }
        (None, None) => {
            let all = |maxima: Maxima| {
                let values: Vec<f32> = seen.iter().flat_map(|r| maxima(r).iter().copied()).collect();
                f64::from(threshold::threshold_of_unstated(&values))
            };
            (all(DYNAMIC), all(TOTAL), VESSEL_RULE)
        }
    }
}

/// Dice between the values above an image's own Otsu threshold and the mask; `None` without a mask.
fn otsu_dice(frame: &Frame, values: &[f32]) -> Option<f64> {
    overlap(frame, values, threshold::vessel_threshold(values).into())
}

fn published_dice(frames: &[&Frame], seen: &[Rendering]) -> PublishedDice {
    let dice = |maxima: Maxima, (frame, rendering): (&&Frame, &Rendering)| {
        overlap(frame, maxima(rendering), PUBLISHED_THRESHOLD)
    };
    PublishedDice {
        threshold_per_mm: PUBLISHED_THRESHOLD / MM_PER_UNIT,
        paper: mean(frames.iter().zip(seen).filter_map(|image| dice(DYNAMIC, image))),
        authors: frames.iter().zip(seen).next().and_then(|image| dice(TOTAL, image)),
    }
}

/// Renders a frame in the size of the view's images.
///
/// # Errors
/// Device errors.
pub fn rendered(renderer: &Renderer, dataset: &Dataset, frame: &Frame) -> Result<Rendering> {
    let [width, height] = dataset.views[frame.view].size;
    renderer.render_taken(&dataset.heart_rays(frame), width, height, frame.beat_time())
}

/// Scores frames of a dataset. `threshold` (per world unit) overrides the rule. `observe` is called for every image; its
/// error ends the work.
///
/// # Errors
/// [`Error::Data`] without frames; device errors; errors of `observe`.
pub fn evaluate(
    renderer: &Renderer,
    dataset: &Dataset,
    frames: &[&Frame],
    step: u32,
    threshold: Option<f64>,
    mut observe: impl FnMut(Scoring<'_>) -> Result<()>,
) -> Result<Evaluation> {
    if frames.is_empty() {
        return Err(Error::data(&dataset.path, "frames", "has no validation frame"));
    }
    let mut seen = Vec::new();
    for frame in frames {
        seen.push(rendered(renderer, dataset, frame)?);
        observe(Scoring::Rendered)?;
    }
    let own: Vec<Cow<'_, Frame>> = frames.iter().map(|frame| dataset.own_frame(frame)).collect();
    let frames: Vec<&Frame> = own.iter().map(Cow::as_ref).collect();
    let blended = renderer.is_blended();
    let (dynamic_threshold, total_threshold, rule) =
        choose_thresholds(&seen, dataset.vessel_attenuation, threshold, blended);
    let mut images = Vec::new();
    for (frame, rendering) in frames.iter().zip(&seen) {
        observe(Scoring::Scored { frame, rendering, threshold: dynamic_threshold })?;
        let overlap = |values: &[f32], threshold: f64| overlap(frame, values, threshold);
        let compared = if blended { metrics::normalised_to_shown } else { metrics::normalised };
        let (truth, prediction) = compared(&frame.integrals, &rendering.total_integral());
        let angles = dataset.views[frame.view].geometry.angles_deg();
        images.push(ImageScore {
            name: frame.name.clone(),
            primary_deg: angles.map(|a| a.0),
            secondary_deg: angles.map(|a| a.1),
            phase: frame.phase,
            dice_dynamic: overlap(&rendering.dynamic_max, dynamic_threshold),
            dice_total: overlap(&rendering.total_max, total_threshold),
            dice_otsu: blended.then(|| otsu_dice(frame, &rendering.dynamic_max)).flatten(),
            psnr: metrics::psnr(&truth, &prediction),
            ssim: metrics::ssim(&truth, &prediction, dataset.views[frame.view].size[0]),
        });
    }
    let mean = |pick: &dyn Fn(&ImageScore) -> Option<f64>| mean(images.iter().filter_map(pick));
    let per_mm = |t: f64| t / MM_PER_UNIT;
    let best = |maxima: Maxima, used: f64| {
        let masked = frames.iter().zip(&seen).filter_map(|(f, r)| Some((maxima(r), f.mask.as_deref()?)));
        let (dice, threshold) = metrics::best_dice(&masked.collect::<Vec<_>>(), used as f32)?;
        Some(BestDice { dice, threshold_per_mm: per_mm(f64::from(threshold)) })
    };
    Ok(Evaluation {
        step,
        dice: DiceMeans { dynamic: mean(&|i| i.dice_dynamic), total: mean(&|i| i.dice_total) },
        dice_as_stated: None,
        best_dice: BestDices { dynamic: best(DYNAMIC, dynamic_threshold), total: best(TOTAL, total_threshold) },
        dice_published: published_dice(&frames, &seen),
        dice_otsu: mean(&|i| i.dice_otsu),
        psnr: mean(&|i| Some(i.psnr)).unwrap_or(f64::NAN),
        ssim: mean(&|i| Some(i.ssim)).unwrap_or(f64::NAN),
        threshold: Thresholds {
            dynamic_per_mm: per_mm(dynamic_threshold),
            total_per_mm: per_mm(total_threshold),
            rule,
        },
        ceiling: None,
        volume: None,
        tree: None,
        warnings: Vec::new(),
        images,
    })
}

/// The training image with the strongest change over time, and that change: the excess over each pixel's minimum over the
/// phases of its view, in all but the strongest [`STRONGEST`] of its pixels. `None` where nothing changes.
fn strongest_change(dataset: &Dataset) -> Option<(&Frame, f64)> {
    let changes = dataset.training_views().into_iter().flat_map(|view| {
        let frames: Vec<&Frame> = dataset.training().iter().filter(|f| f.view == view).collect();
        let images: Vec<_> = frames.iter().map(|f| dataset.own(view, &f.integrals)).collect();
        let min = |p: usize| images.iter().map(|image| image[p]).fold(f32::INFINITY, f32::min);
        let still: Vec<f32> = (0..images[0].len()).map(min).collect();
        frames.into_iter().zip(images).map(move |(frame, image)| {
            let above: Vec<f32> = image.iter().zip(&still).map(|(v, s)| v - s).collect();
            (frame, f64::from(percentile(&above, 1.0 - STRONGEST)))
        })
    });
    changes.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, change)| *change > 0.0)
}

/// Returns a warning when the dynamic field has vanished: when its line integrals in the image with the strongest change
/// over time reach less than a tenth of that change.
///
/// # Errors
/// Device errors.
pub fn moving_field_warning(renderer: &Renderer, dataset: &Dataset) -> Result<Option<String>> {
    // The values of X-Gaussian have no unit to be compared with a change.
    if renderer.is_blended() {
        return Ok(None);
    }
    let Some((frame, change)) = strongest_change(dataset) else { return Ok(None) };
    let seen = rendered(renderer, dataset, frame)?;
    let strongest = f64::from(seen.dynamic_integral.iter().copied().fold(0.0, f32::max));
    let why = match (renderer.network_moves(), renderer.has_hull()) {
        (true, false) => {
            "The run may be too short, or dynamic.lr too high: try a longer run, a lower rate or another seed, and \
             check geometry and phases"
        }
        (true, true) => {
            "Views may disagree by more than the motion hull allows: check geometry and phases, or try \
             hull.enabled=false, a lower dynamic.lr or another seed"
        }
        (false, _) => {
            "Views may disagree by more than the motion hull allows: check geometry, phases and noise of the views"
        }
    };
    Ok((strongest < DEAD_SHARE * change).then(|| {
        format!(
            "The dynamic field has become almost zero: its maximum line integral is {strongest:.2e}, but the images \
             change by {change:.2e}. Dice is meaningless here. {why}."
        )
    }))
}

/// Selects `n` of the dataset's validation frames, evenly spread.
pub fn spread_validation(dataset: &Dataset, n: usize) -> Vec<&Frame> {
    let all = dataset.validation();
    let n = n.min(all.len());
    let mut picked: Vec<usize> = (0..n).map(|i| ((i as f64 + 0.5) * all.len() as f64 / n as f64) as usize).collect();
    picked.dedup();
    picked.into_iter().map(|i| &all[i]).collect()
}
