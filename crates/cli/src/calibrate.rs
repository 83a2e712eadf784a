//! `calibrate`: makes a dataset with consistent views.

use super::calibration_table;
use super::options::choice;
use clap::Args;
use nertca_vk::calibrate::calibrate;
use nertca_vk::config::{CalibrateMode, Config, Preset};
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::run::silhouette_pictures;
use nertca_vk::scan::dataset::{Dataset, Layout, MANIFEST};
use nertca_vk::scan::writer;
use std::path::PathBuf;

/// Arguments of `calibrate`.
#[derive(Debug, Args)]
pub struct CalibrateArgs {
    /// Dataset directory in either layout.
    pub data: PathBuf,
    /// Parameters to correct.
    #[arg(long, value_parser = choice::<CalibrateMode>(), default_value = "auto")]
    pub mode: CalibrateMode,
    /// Dataset directory to write: the same images with corrected geometry; pictures of the changes are in its folder
    /// `calibration`.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Folder in the dataset for the description and pictures of the correction.
const FOLDER: &str = "calibration";

/// Corrects a dataset.
pub fn run(args: &CalibrateArgs) -> Result<()> {
    let dataset = Dataset::open(&args.data)?;
    if args.out.join(MANIFEST).exists() {
        return Err(Error::config("--out", args.out.display(), "already contains a dataset; choose another directory"));
    }
    let mut config = Config::preset(Preset::Fast);
    config.calibrate.mode = args.mode;
    let calibration = calibrate(&dataset, &config)?;
    let corrected = dataset.corrected(&calibration)?;
    let description = format!("calibrated from {}", dataset.path.display());
    writer::write(&corrected, Layout::Native, &args.out, description, &|view| calibration.stated(view).cloned())?;
    let folder = args.out.join(FOLDER);
    files::create_directory(&folder)?;
    calibration.write(&folder)?;
    silhouette_pictures::write(&folder, &dataset, &corrected)?;
    if args.json {
        out!("{}", files::pretty_json(&calibration)?);
    } else {
        calibration_table::print(&calibration);
        out!("dataset: {}, pictures before and after the correction: {}", args.out.display(), folder.display());
    }
    Ok(())
}
