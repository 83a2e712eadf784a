//! How results are shown: what rows and columns stand for.

use crate::study::scores::Score;
use serde::Deserialize;

/// What rows and columns of a table can be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Dimension {
    /// What is seen.
    Data,
    /// From how many views.
    Views,
    /// How it is reconstructed.
    Method,
}

/// How results are shown.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TableLayout {
    /// What columns stand for; rows stand for the rest.
    pub columns: Vec<Dimension>,
    /// What is shown in each of them.
    pub scores: Vec<Score>,
}

impl Default for TableLayout {
    /// That of the paper's first table.
    fn default() -> Self {
        TableLayout {
            columns: vec![Dimension::Views],
            scores: vec![Score::Dice, Score::Psnr, Score::Ssim, Score::Minutes, Score::Fps],
        }
    }
}

impl Dimension {
    /// Heading of a column that names it.
    pub fn heading(self) -> &'static str {
        match self {
            Dimension::Data => "data",
            Dimension::Views => "views",
            Dimension::Method => "method",
        }
    }
}
