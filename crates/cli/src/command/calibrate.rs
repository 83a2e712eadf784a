//! `calibrate`: makes a dataset with consistent views.

use crate::args::options::choice;
use crate::output::{CALIBRATION, KeptReferences, write_dataset};
use crate::pages::calibration_table;
use clap::Args;
use nertca_vk::calibrate::settings::{CalibrateMode, CalibrateSettings};
use nertca_vk::error::Result;
use nertca_vk::files;
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::scan::writer;
use nertca_vk_runs::prepare::Prepared;
use nertca_vk_runs::run::silhouette_pictures;
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
    /// Replace a dataset that the directory already contains.
    #[arg(short, long)]
    pub force: bool,
    /// Keep the references to the runs that `import dicom --keep-references` has written, which name the patient.
    #[arg(long)]
    pub keep_references: bool,
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// Corrects a dataset.
pub fn run(args: &CalibrateArgs) -> Result<()> {
    let dataset = Dataset::open(&args.data)?;
    let references = KeptReferences::of(&dataset, args.keep_references)?;
    // A dataset may be reconstructed with every preset, the default one included, whose field moves with each frame.
    let settings = CalibrateSettings { mode: args.mode, follows_breath: true };
    let calibration = write_dataset(&args.out, args.force, |out| {
        let calibration = Prepared::calibrated(&dataset, settings)?.calibration;
        let corrected = dataset.corrected(&calibration)?;
        let description = format!("calibrated from {}", dataset.path.display());
        let stated = |view| calibration.stated(view).cloned();
        let image_files = writer::write(&corrected, Layout::Native, out, description, &stated)?;
        references.write(&image_files, out)?;
        let folder = out.join(CALIBRATION);
        files::create_directory(&folder)?;
        calibration.write(&folder)?;
        silhouette_pictures::write(&folder, &dataset, &corrected)?;
        Ok(calibration)
    })?;
    let folder = args.out.join(CALIBRATION);
    if args.json {
        out!("{}", files::pretty_json(&calibration)?);
    } else {
        calibration_table::print(&calibration);
        out!("dataset: {}, pictures before and after the correction: {}", args.out.display(), folder.display());
    }
    Ok(())
}
