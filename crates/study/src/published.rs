//! Values that others have published, shown beside our own results and never in place of them.

use crate::scores::Score;
use crate::text::Text;
use nertca_vk::error::Result;
use nertca_vk::files;
use serde::Deserialize;
use std::path::Path;

const MAX_BYTES: u64 = 1 << 20;

/// Published values, from a TOML file.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Published {
    /// Publication they come from.
    pub source: String,
    /// Notes on the comparison.
    pub note: Option<String>,
    rows: Vec<PublishedRow>,
}

/// Values of a method, on one data set or on all.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
struct PublishedRow {
    method: String,
    /// Name of the data set in studies; if missing, the values are means over all data sets.
    data: Option<String>,
    views: Option<u32>,
    dice: Option<f64>,
    psnr: Option<f64>,
    ssim: Option<f64>,
    minutes: Option<f64>,
    fps: Option<f64>,
}

impl PublishedRow {
    fn value(&self, score: Score) -> Option<f64> {
        match score {
            Score::Dice | Score::DicePaper => self.dice,
            Score::Psnr => self.psnr,
            Score::Ssim => self.ssim,
            Score::Minutes => self.minutes,
            Score::Fps => self.fps,
            _ => None,
        }
    }
}

impl Published {
    /// Reads published values from a file.
    ///
    /// # Errors
    /// [`nertca_vk::error::Error::Data`] with the line of the problem; [`nertca_vk::error::Error::Io`].
    pub fn read(file: &Path) -> Result<Published> {
        let text = files::read_text(file, MAX_BYTES)?;
        Text { file, text: &text }.parse()
    }

    /// Methods with published values, in the order of the file.
    pub fn methods(&self) -> Vec<&str> {
        let mut methods: Vec<&str> = Vec::new();
        for row in &self.rows {
            if !methods.contains(&row.method.as_str()) {
                methods.push(&row.method);
            }
        }
        methods
    }

    /// Published value of a method on a data set, or its mean over all data sets where only that was published.
    pub fn value(&self, method: &str, data: &str, views: Option<u32>, score: Score) -> Option<f64> {
        let of_method = || self.rows.iter().filter(|row| row.method == method);
        let here = of_method().filter(|row| row.data.as_deref() == Some(data) && row.views == views);
        let everywhere = of_method().filter(|row| row.data.is_none());
        here.chain(everywhere).find_map(|row| row.value(score))
    }
}
