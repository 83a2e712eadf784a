//! What a run tells its observer.

use crate::fitting::losses::StepLoss;
use crate::gpu::record::PassTime;
use serde::Serialize;
use std::path::PathBuf;

/// What a run tells its observer; also the lines of `metrics.jsonl`.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// Training begins or continues.
    Started {
        /// Device name.
        device: String,
        /// Iterations already done.
        step: u32,
        /// Length of the run.
        iterations: u32,
        /// Parameters.
        parameters: usize,
        /// Decisions about data and device.
        notes: Vec<String>,
    },
    /// What comes before the first iteration: Gaussians that are sought and followed through the beat; not a line of
    /// `metrics.jsonl`.
    Preparing {
        /// Share of it that is done, 0 to 1.
        share: f64,
    },
    /// Losses, every few iterations.
    Progress {
        /// Losses of the last iteration.
        #[serde(flatten)]
        loss: StepLoss,
        /// Loss of the moving field over that of no field, where a network moves: next to 1, it has died.
        #[serde(skip_serializing_if = "Option::is_none")]
        dynamic_share: Option<f64>,
        /// PSNR of the training rays, dB, smoothed.
        psnr: f64,
        /// Iterations per second.
        iterations_per_s: f64,
        /// Seconds of training so far, validation and saving included.
        elapsed_s: f64,
        /// Estimated seconds to the end.
        left_s: f64,
    },
    /// A loss far above the first one; training goes on.
    LargeLoss {
        /// Iterations done after it.
        step: u32,
        /// The loss.
        loss: f64,
        /// The loss over the first one of this start.
        ratio: f64,
    },
    /// Metrics on some unseen images.
    Validation {
        /// Iterations done.
        step: u32,
        /// Seconds spent training until then; wall time where validation runs beside training, otherwise without it.
        train_s: f64,
        /// Dice of the dynamic field.
        dice_dynamic: Option<f64>,
        /// Dice of both fields.
        dice_total: Option<f64>,
        /// dB.
        psnr: f64,
        /// Structural similarity.
        ssim: f64,
        /// Where the dataset has its vessels as volumes: mean distance to them (Chamfer) at the end of systole, mm.
        #[serde(skip_serializing_if = "Option::is_none")]
        chamfer_mm: Option<f64>,
    },
    /// A checkpoint was written.
    Saved {
        /// Iterations it holds.
        step: u32,
        /// File.
        path: PathBuf,
    },
    /// Images of the evaluation after training, one by one; not a line of `metrics.jsonl`.
    Evaluation {
        /// Images rendered so far.
        images: usize,
        /// Images in all.
        of: usize,
        /// Seconds of evaluation so far.
        elapsed_s: f64,
        /// Estimated seconds to the end; none before the first image.
        left_s: Option<f64>,
    },
    /// Device time of each pass of one more iteration, whose result is not kept.
    Profile {
        /// Iterations done before.
        step: u32,
        /// In order.
        passes: Vec<PassTime>,
    },
    /// The run reached its end or the requested stop.
    Finished {
        /// Iterations done.
        step: u32,
        /// Seconds spent training, validation excluded.
        train_s: f64,
        /// Seconds in all.
        elapsed_s: f64,
        /// Loss of the moving network as a share of the loss without one; none where Gaussians move.
        #[serde(skip_serializing_if = "Option::is_none")]
        dynamic_share: Option<f64>,
    },
}
