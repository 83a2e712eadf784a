//! Names of the scores that tables can show, and their presentation.

use serde::{Deserialize, Serialize};
use strum::{IntoStaticStr, VariantArray};

/// A number of a run that a table can show.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Score {
    /// Dice of the dynamic field, by the rule of `eval`.
    Dice,
    /// Dice of both fields, by the rule of `eval`.
    DiceTotal,
    /// Dice of the dynamic field at the authors' threshold, on all unseen images.
    DicePaper,
    /// Dice of both fields at the authors' threshold, on the first unseen image.
    DiceAuthors,
    /// Dice of the dynamic field at the threshold that fits the true masks best.
    DiceBest,
    /// Dice of X-Gaussian with Otsu's threshold of each image.
    DiceOtsu,
    /// Peak signal-to-noise ratio, dB.
    Psnr,
    /// Structural similarity.
    Ssim,
    /// Mean distance to the true vessels, mm.
    ChamferMm,
    /// 95th percentile of the distance to the true vessels, mm.
    Hausdorff95Mm,
    /// Centreline Dice in 3D.
    ClDice,
    /// Training time, minutes.
    Minutes,
    /// Images rendered per second.
    Fps,
}

/// Presentation of a score.
struct Presentation {
    heading: &'static str,
    meaning: &'static str,
    digits: usize,
    more_is_better: bool,
}

impl Score {
    fn look(self) -> Presentation {
        let (heading, meaning, digits, more_is_better) = match self {
            Score::Dice => {
                let meaning = "dynamic field on all unseen images, thresholded at a fifth of the stated attenuation of \
                               vessels (of the strongest attenuation where none is stated, at 0.05 for X-Gaussian's opacities)";
                ("Dice", meaning, 3, true)
            }
            Score::DiceTotal => ("Dice, total", "both fields, otherwise like Dice", 3, true),
            Score::DicePaper => {
                let meaning = "as the paper describes it: dynamic field on all unseen images, at the authors' \
                               threshold of 0.05 per 100 mm";
                ("Dice, paper's way", meaning, 3, true)
            }
            Score::DiceAuthors => {
                let meaning = "as the authors' code does it: sum of both fields on the first unseen image, at 0.05 per \
                               100 mm";
                ("Dice, authors' code", meaning, 3, true)
            }
            Score::DiceBest => {
                ("best Dice", "at the best threshold, which needs the masks and is therefore not a score", 3, true)
            }
            Score::DiceOtsu => {
                let meaning = "for X-Gaussian only: Otsu's threshold of the sums of opacities of each unseen image";
                ("Dice, Otsu", meaning, 3, true)
            }
            Score::Psnr => ("PSNR", "dB, unseen images", 2, true),
            Score::Ssim => ("SSIM", "unseen images", 3, true),
            Score::ChamferMm => ("Chamfer, mm", "mean distance to the true vessels", 2, false),
            Score::Hausdorff95Mm => ("Hausdorff 95 %, mm", "distance to the true vessels", 2, false),
            Score::ClDice => ("clDice", "centrelines in 3D", 3, true),
            Score::Minutes => ("minutes", "of training", 2, false),
            Score::Fps => {
                ("FPS", "frames per second of renderings of all scored fields, at the size of the images", 2, true)
            }
        };
        Presentation { heading, meaning, digits, more_is_better }
    }

    /// Heading of the score's column.
    pub fn heading(self) -> &'static str {
        self.look().heading
    }

    /// Explanation of the score, to follow its heading.
    pub fn meaning(self) -> &'static str {
        self.look().meaning
    }

    /// Digits after the decimal point.
    pub fn digits(self) -> usize {
        self.look().digits
    }

    /// Tells whether the largest value is the best.
    pub fn more_is_better(self) -> bool {
        self.look().more_is_better
    }

    /// Formats a value as tables show it.
    pub fn text(self, value: f64) -> String {
        format!("{value:.*}", self.digits())
    }
}
