//! Results of the runs of a study. A run writes its result as `result.json` into its directory at its end. `results.jsonl` in the study's
//! directory has one result per line, of runs whose directories need not be there.

use crate::plan::{Run, RunFingerprint, Study};
use crate::scores::Score;
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk_runs::run::history::Validated;
use nertca_vk_vessels::score::eval::Evaluation;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Name of the file inside a run directory.
pub const RESULT: &str = "result.json";
/// Name of the file with the results of many runs, inside the directory of a study.
pub const RESULTS: &str = "results.jsonl";
const FORMAT: &str = "nertca-study-result";
const VERSION: u32 = 1;
const MAX_BYTES: u64 = 16 << 20;
const MAX_RESULTS_BYTES: u64 = 1 << 30;

/// Result of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Outcome {
    /// Always `nertca-study-result`.
    format: String,
    /// Version of this layout: 1.
    version: u32,
    /// Name of the run.
    pub run: String,
    /// Fingerprint of data, configuration and program.
    pub fingerprint: RunFingerprint,
    /// Seed of data and training.
    pub seed: u32,
    /// Name of the device.
    pub device: String,
    /// Driver of the device, with its version.
    pub driver: String,
    /// Iterations completed.
    pub iterations: u32,
    /// Duration of the run.
    pub seconds: Seconds,
    /// Dice of some unseen images over the time of training, where the run was validated during training.
    pub curve: Vec<CurvePoint>,
    /// Scores on all unseen images; none for a run that failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub scores: Option<RunScores>,
    /// Reason of the failure, if the run failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
}

/// Duration of a run, seconds. For a run that was interrupted: the sum over its parts, as far as they were recorded.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Seconds {
    /// Training time. Interrupted parts are counted up to the last report before their checkpoint, including saving and
    /// validation.
    pub training: f64,
    /// Time from opening the dataset to the scores.
    pub whole: f64,
    /// Number of parts: 1 for a run without interruption.
    pub parts: u32,
}

/// A validation during training.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CurvePoint {
    /// Iterations completed.
    pub step: u32,
    /// Seconds of training up to this validation.
    pub train_s: f64,
    /// Dice of the dynamic field, where images have masks.
    pub dice: Option<f64>,
    /// Distance to the true vessels at one phase, mm, where the data have them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub chamfer_mm: Option<f64>,
}

impl CurvePoint {
    /// Keeps the part of a validation that a study records.
    pub(super) fn of(validated: &Validated) -> CurvePoint {
        let Validated { step, train_s, dice, chamfer_mm, .. } = *validated;
        CurvePoint { step, train_s, dice, chamfer_mm }
    }
}

/// Scores of a run: means over unseen images or over phases. `report/evaluation.json` in the run directory has all values.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RunScores {
    /// Dice of the dynamic field.
    pub dice: Option<f64>,
    /// Dice of both fields.
    pub dice_total: Option<f64>,
    /// Dice of the dynamic field with the unseen views as stated, for data whose views calibration has moved.
    pub dice_as_stated: Option<f64>,
    /// Dice of the dynamic field with the best threshold.
    pub dice_best: Option<f64>,
    /// Dice of the dynamic field at the authors' threshold, as in the paper.
    pub dice_paper: Option<f64>,
    /// Dice of both fields in the first image at the authors' threshold, as in their code.
    pub dice_authors: Option<f64>,
    /// Dice of X-Gaussian with Otsu's threshold of each image.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dice_otsu: Option<f64>,
    /// Peak signal-to-noise ratio, dB.
    pub psnr: Option<f64>,
    /// Structural similarity.
    pub ssim: Option<f64>,
    /// Distance to the true vessels, mm.
    pub chamfer_mm: Option<f64>,
    /// 95th percentile of the distance to the true vessels, mm.
    pub hausdorff95_mm: Option<f64>,
    /// Centreline Dice in 3D.
    pub cl_dice: Option<f64>,
    /// Attenuation from which the dynamic field counts as vessel, per mm.
    pub threshold_per_mm: f64,
    /// Rule by which the threshold was chosen.
    pub threshold_rule: String,
    /// Number of unseen images.
    pub images: usize,
    /// Images rendered per second in the evaluation: all fields that are scored, at the size of the images.
    pub fps: Option<f64>,
    /// Limitations of the scores.
    pub warnings: Vec<String>,
}

impl RunScores {
    /// Keeps the scores of an evaluation.
    pub fn new(evaluation: &Evaluation, fps: Option<f64>) -> RunScores {
        let finite = |value: f64| Some(value).filter(|v| v.is_finite());
        let volume = evaluation.volume.as_ref().map(|volume| &volume.mean.agreement);
        RunScores {
            dice: evaluation.dice.dynamic,
            dice_total: evaluation.dice.total,
            dice_as_stated: evaluation.dice_as_stated.as_ref().and_then(|dice| dice.dynamic),
            dice_best: evaluation.best_dice.dynamic.map(|best| best.dice),
            dice_paper: evaluation.dice_published.paper,
            dice_authors: evaluation.dice_published.authors,
            dice_otsu: evaluation.dice_otsu,
            psnr: finite(evaluation.psnr),
            ssim: finite(evaluation.ssim),
            chamfer_mm: volume.and_then(|v| v.chamfer_mm),
            hausdorff95_mm: volume.and_then(|v| v.hausdorff95_mm),
            cl_dice: volume.and_then(|v| v.cl_dice),
            threshold_per_mm: evaluation.threshold.dynamic_per_mm,
            threshold_rule: evaluation.threshold.rule.to_owned(),
            images: evaluation.images.len(),
            fps,
            warnings: evaluation.warnings.clone(),
        }
    }
}

/// Directory of a run inside a study's directory.
pub fn run_directory(study: &Path, run: &Run) -> PathBuf {
    study.join("runs").join(&run.id)
}

impl Outcome {
    /// An outcome without scores or failure yet.
    pub(super) fn new(run: &Run, fingerprint: RunFingerprint) -> Outcome {
        Outcome {
            format: FORMAT.to_owned(),
            version: VERSION,
            run: run.id.clone(),
            fingerprint,
            seed: run.seed,
            device: String::new(),
            driver: String::new(),
            iterations: 0,
            seconds: Seconds::default(),
            curve: Vec::new(),
            scores: None,
            failure: None,
        }
    }

    pub(super) fn write(&self, directory: &Path) -> Result<()> {
        Ok(files::write_atomic(&directory.join(RESULT), files::pretty_json(self)?.as_bytes())?)
    }

    /// Parses a result that begins at a line of a file.
    fn parse(text: &str, file: &Path, first_line: usize) -> Result<Outcome> {
        let outcome: Outcome = serde_json::from_str(text)
            .map_err(|e| Error::data(file, format!("line {}", first_line + e.line() - 1), e.to_string()))?;
        if outcome.format != FORMAT || outcome.version != VERSION {
            let found = format!("`{}` version {}", outcome.format, outcome.version);
            let problem = format!("the format is {found}, but `{FORMAT}` version {VERSION} is expected");
            return Err(Error::data(file, format!("line {first_line}"), problem));
        }
        Ok(outcome)
    }

    /// Value of a score, if the run has it.
    pub fn score(&self, score: Score) -> Option<f64> {
        let scores = self.scores.as_ref()?;
        match score {
            Score::Dice => scores.dice,
            Score::DiceTotal => scores.dice_total,
            Score::DicePaper => scores.dice_paper,
            Score::DiceAuthors => scores.dice_authors,
            Score::DiceBest => scores.dice_best,
            Score::DiceOtsu => scores.dice_otsu,
            Score::Psnr => scores.psnr,
            Score::Ssim => scores.ssim,
            Score::ChamferMm => scores.chamfer_mm,
            Score::Hausdorff95Mm => scores.hausdorff95_mm,
            Score::ClDice => scores.cl_dice,
            Score::Minutes => Some(self.seconds.training / 60.0),
            Score::Fps => scores.fps,
        }
    }
}

/// Results in the directory of a study.
#[derive(Debug)]
pub struct Results<'a> {
    /// Directory of the study.
    pub directory: &'a Path,
    /// Lines of `results.jsonl`, by the name of the run.
    collected: BTreeMap<String, Outcome>,
}

impl<'a> Results<'a> {
    /// Opens the results in the directory of a study.
    ///
    /// # Errors
    /// [`Error::Data`] for a `results.jsonl` of another kind or version; [`Error::Io`].
    pub fn open(directory: &'a Path) -> Result<Results<'a>> {
        let file = directory.join(RESULTS);
        let mut collected = BTreeMap::new();
        if file.exists() {
            for (number, line) in files::read_text(&file, MAX_RESULTS_BYTES)?.lines().enumerate() {
                let outcome = Outcome::parse(line, &file, number + 1)?;
                collected.insert(outcome.run.clone(), outcome);
            }
        }
        Ok(Results { directory, collected })
    }

    /// Result of a run: the file in its directory, or else its line; none if there is neither.
    ///
    /// # Errors
    /// [`Error::Data`] for a file of another kind or version; [`Error::Io`].
    pub fn read(&self, run: &Run) -> Result<Option<Outcome>> {
        let file = run_directory(self.directory, run).join(RESULT);
        if file.exists() {
            return Outcome::parse(&files::read_text(&file, MAX_BYTES)?, &file, 1).map(Some);
        }
        Ok(self.collected.get(&run.id).cloned())
    }

    /// Result of a run if it was made from exactly these data, with this configuration and, unless results of any commit count,
    /// with this program.
    ///
    /// # Errors
    /// Errors of [`Results::read`].
    pub fn of(&self, study: &Study, run: &Run, any_commit: bool) -> Result<Option<Outcome>> {
        let wanted = study.fingerprint(run)?;
        let counts = |made: &RunFingerprint| if any_commit { made.asks_the_same(&wanted) } else { *made == wanted };
        Ok(self.read(run)?.filter(|outcome| counts(&outcome.fingerprint)))
    }

    /// Writes `results.jsonl`: the results of all runs of a study, and earlier lines of other runs, in the order of their names. Returns
    /// the number of lines.
    ///
    /// # Errors
    /// Errors of [`Results::read`] and of writing.
    pub fn collect(mut self, study: &Study) -> Result<usize> {
        for run in study.runs() {
            if let Some(outcome) = self.read(&run)? {
                self.collected.insert(run.id, outcome);
            }
        }
        let mut text = Vec::new();
        for outcome in self.collected.values() {
            serde_json::to_writer(&mut text, outcome).map_err(|e| Error::Internal(e.to_string()))?;
            text.push(b'\n');
        }
        files::write_atomic(&self.directory.join(RESULTS), &text)?;
        Ok(self.collected.len())
    }
}
