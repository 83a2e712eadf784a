//! Layout of result tables: the meaning of rows and columns.

use crate::scores::Score;
use serde::Deserialize;

/// Dimension of a study that rows or columns of a table can stand for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Dimension {
    /// Data set.
    Data,
    /// Number of views.
    Views,
    /// Reconstruction method.
    Method,
}

/// Layout of the results of a study.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TableLayout {
    /// Dimensions that columns stand for; rows stand for the others.
    pub columns: Vec<Dimension>,
    /// Scores shown in each column group.
    pub scores: Vec<Score>,
}

impl Default for TableLayout {
    /// Layout of the paper's first table.
    fn default() -> Self {
        TableLayout {
            columns: vec![Dimension::Views],
            scores: vec![Score::Dice, Score::Psnr, Score::Ssim, Score::Minutes, Score::Fps],
        }
    }
}

impl Dimension {
    /// Heading of a column of row names for this dimension.
    pub fn heading(self) -> &'static str {
        match self {
            Dimension::Data => "data",
            Dimension::Views => "views",
            Dimension::Method => "method",
        }
    }
}
