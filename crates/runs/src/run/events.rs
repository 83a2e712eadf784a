//! Events that a run reports to its observer.

use crate::check::Check;
use crate::files;
use crate::fitting::losses::StepLoss;
use crate::gpu::record::PassTime;
use serde::Serialize;
use std::path::PathBuf;
use std::time::Instant;

/// Stage of a run; they are listed in its order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, serde::Deserialize, strum::IntoStaticStr)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
pub enum Stage {
    /// The dataset and the prior are read.
    Read,
    /// The device is opened.
    Device,
    /// Views are compared, calibrated and adjusted.
    Calibrate,
    /// Hull, boxes and scales are chosen.
    Plan,
    /// Kernels are compiled, data are uploaded, and the fields get their start.
    Prepare,
    /// Iterations, with the checkpoints and validations between them.
    Iterate,
    /// Unseen images and volumes are scored.
    Score,
    /// The vessels are found as a tree.
    Tree,
    /// The report is written.
    Report,
}

impl Stage {
    /// Returns its name, as in `run.json`.
    pub fn name(self) -> &'static str {
        self.into()
    }
}

/// Time of a stage of a run.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, serde::Deserialize)]
pub struct StageTime {
    /// The stage.
    pub stage: Stage,
    /// Wall time, seconds.
    pub seconds: f64,
}

/// Clock of a run's stages, one after the other.
pub struct StageClock(Instant);

impl StageClock {
    /// Starts with the first stage.
    pub fn start() -> StageClock {
        StageClock(Instant::now())
    }

    /// Ends a stage, and starts with the next one.
    pub fn end(&mut self, stage: Stage) -> StageTime {
        let seconds = self.0.elapsed().as_secs_f64();
        self.0 = Instant::now();
        StageTime { stage, seconds }
    }
}

/// Event that a run reports to its observer; also a line of `metrics.jsonl`.
#[derive(Debug, Clone, Serialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// Training begins or continues.
    Started {
        /// Device name.
        device: String,
        /// Iterations already done.
        step: u32,
        /// Total number of iterations of the run.
        iterations: u32,
        /// Number of parameters.
        parameters: usize,
        /// Decisions about data and device.
        notes: Vec<String>,
    },
    /// Estimate of the memory of a new run, before its data are analysed; not a line of `metrics.jsonl`.
    Memory {
        /// Memory of the host, MiB.
        host_mib: u64,
        /// Memory of the device, MiB.
        device_mib: u64,
        /// Both at once where the memory of the device is that of the host, MiB.
        together_mib: u64,
    },
    /// Comparison of the training views as stated, which a new run makes where two of them show two phases. It follows
    /// [`Event::Started`], or comes alone where the run cannot start.
    Checked {
        /// Iterations done, 0.
        step: u32,
        /// Outcome in words.
        conclusion: String,
        /// The comparison.
        #[serde(flatten)]
        check: Box<Check>,
    },
    /// Adjustment of the views with the field in the loop, before the run starts; not a line of `metrics.jsonl`.
    Adjusting {
        /// Share of the adjustment that is done, 0 to 1.
        share: f64,
    },
    /// Preparation before the first iteration: Gaussians are placed and followed through the beat; not a line of
    /// `metrics.jsonl`.
    Preparing {
        /// Share of the preparation that is done, 0 to 1.
        share: f64,
    },
    /// Losses, every few iterations.
    Progress {
        /// Losses of the last iteration.
        #[serde(flatten)]
        loss: StepLoss,
        /// Loss of the dynamic field divided by that of no field, for a dynamic network: near 1, it has vanished.
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
    /// A loss far above the first one; training continues.
    LargeLoss {
        /// Iterations done after it.
        step: u32,
        /// The loss.
        loss: f64,
        /// The loss divided by the first one of this start.
        ratio: f64,
    },
    /// Finding about the data that the fit has led to, such as a catheter in the dynamic field.
    Found {
        /// Iterations done.
        step: u32,
        /// The finding, in words.
        note: String,
    },
    /// Metrics on a selection of unseen images.
    Validation {
        /// Iterations done.
        step: u32,
        /// Seconds spent training so far; wall time where validation runs beside training, otherwise without validation.
        train_s: f64,
        /// Dice of the dynamic field.
        dice_dynamic: Option<f64>,
        /// Dice of both fields.
        dice_total: Option<f64>,
        /// Peak signal-to-noise ratio, dB.
        psnr: f64,
        /// Structural similarity.
        ssim: f64,
        /// Strongest line integral of the dynamic field, as a share of that of both fields; none where it is no network, or has not begun.
        #[serde(skip_serializing_if = "Option::is_none")]
        dynamic_integral: Option<f64>,
        /// Mean distance to the true vessels (Chamfer) at the end of systole, mm, where the dataset has its vessels as
        /// volumes.
        #[serde(skip_serializing_if = "Option::is_none")]
        chamfer_mm: Option<f64>,
    },
    /// A checkpoint was written.
    Saved {
        /// Iterations it holds.
        step: u32,
        /// File; where its path is not text in UTF-8, the line holds its bytes.
        #[serde(serialize_with = "files::path_in_json::serialize")]
        path: PathBuf,
    },
    /// Progress of the evaluation after training, image by image; not a line of `metrics.jsonl`.
    Evaluation {
        /// Images rendered so far.
        images: usize,
        /// Total number of images.
        of: usize,
        /// Seconds of evaluation so far.
        elapsed_s: f64,
        /// Estimated seconds to the end; `None` before the first image.
        left_s: Option<f64>,
    },
    /// Device time of each pass of one more iteration, whose result is not kept.
    Profile {
        /// Iterations done before.
        step: u32,
        /// Passes in order of execution.
        passes: Vec<PassTime>,
    },
    /// The run reached its end or the requested stop.
    Finished {
        /// Share of the attenuation of one fit of Gaussians that lies in vessels of another, where the dynamic field is the mean of
        /// several fits.
        #[serde(skip_serializing_if = "Option::is_none")]
        agreement: Option<f64>,
        /// Iterations done.
        step: u32,
        /// Seconds spent training, validation excluded.
        train_s: f64,
        /// Total seconds.
        elapsed_s: f64,
        /// Loss of the dynamic network as a share of the loss without one; `None` for dynamic Gaussians.
        #[serde(skip_serializing_if = "Option::is_none")]
        dynamic_share: Option<f64>,
        /// Times of the stages from [`Stage::Calibrate`] to [`Stage::Iterate`].
        stages: Vec<StageTime>,
    },
}
