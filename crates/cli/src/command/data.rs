//! The commands `phantom`, `project` and `import`.

use crate::args::dicom_args::DicomArgs;
use crate::args::options::GlobalOptions;
use crate::args::picture_args::{self, ImportPicturesArgs};
use crate::args::rtk_args::{self, ImportRtkArgs};
use crate::args::synthetic_args::{PhantomArgs, ProjectArgs};
use crate::output::write_dataset;
use clap::{Args, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use nertca_vk::error::{Error, Result};
use nertca_vk::formats::volume::VolumeHints;
use nertca_vk::scan::dataset::Layout;
use nertca_vk_import::angiograms::ImportOptions;
use nertca_vk_import::intake::import_dicom_as_stated;
use nertca_vk_phantom::acquisition::Acquisition;
use nertca_vk_phantom::dataset::{Anatomy, PhantomOptions, VolumeOptions, make_with_runs, project_volumes};
use nertca_vk_phantom::degradations::Degradations;
use std::path::{Path, PathBuf};

/// Arguments of `import`.
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// Kind of data to import.
    #[command(subcommand)]
    pub source: ImportSource,
}

/// Kinds of data that can be imported.
#[derive(Debug, Subcommand)]
pub enum ImportSource {
    /// X-ray angiography runs (DICOM XA or RF, multi-frame), one file per view.
    Dicom(ImportDicomArgs),
    /// X-ray angiography runs as pictures (PNG, JPEG, TIFF), one folder of frames per view, with a geometry by options.
    Pictures(ImportPicturesArgs),
    /// Projections with a geometry of the Reconstruction Toolkit (RTK): one stack, and a matrix for each projection.
    Rtk(ImportRtkArgs),
}

/// Arguments of `import dicom`.
#[derive(Debug, Args)]
pub struct ImportDicomArgs {
    /// One file per view.
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// Directory to write.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Replace a dataset that the directory already contains.
    #[arg(short, long)]
    pub force: bool,
    /// Keep references to the files in `references.json` of the dataset, so that results can be filed with them (`tree --presentation`):
    /// UIDs and frame numbers, name and identifier of the patient, date of the study. By default, the dataset contains none of this.
    #[arg(long)]
    pub keep_references: bool,
    /// Options of reading runs.
    #[command(flatten)]
    pub reading: DicomArgs,
}

/// Returns a progress bar for work whose length becomes known during the work.
pub fn bar() -> impl FnMut(&str, u64, u64) {
    let bar = ProgressBar::new(1);
    if let Ok(style) = ProgressStyle::with_template("{msg:12} [{bar:30}] {pos}/{len} {elapsed}") {
        bar.set_style(style);
    }
    move |what, done, total| {
        bar.set_message(what.to_owned());
        bar.set_length(total);
        bar.set_position(done);
    }
}

/// Tells the user that the authors' layout cannot store times between phases.
fn tell_of_times(layout: Layout, degradations: &Degradations) {
    if layout == Layout::Nerfca && degradations.rhythm.is_some() {
        eprintln!("this layout has whole phases only: frames between two phases get the nearest phase");
    }
}

fn warn(warnings: &[String]) {
    warnings.iter().for_each(|warning| eprintln!("warning: {warning}"));
}

/// Makes a phantom.
pub fn phantom(global: &GlobalOptions, args: &PhantomArgs) -> Result<()> {
    if args.tree.is_none() && !args.c_arm.is_default() {
        let problem = "--sod, --sid, --fov, --pixel and --offset need --tree, because a published set-up has its own \
                       C-arm";
        return Err(Error::config("--tree", "none", problem));
    }
    let gpu = global.open_device()?;
    let options = PhantomOptions {
        setting: args.geometry,
        size: args.size,
        phases: args.phases,
        views: args.views.views()?,
        seed: args.seed,
        degradations: args.degradations.degradations(args.catheter),
        stenoses: args.stenosis.clone(),
        layout: args.layout,
        anatomy: args.tree.as_ref().map(|tree| Anatomy {
            tree: tree.clone(),
            background: args.background.clone(),
            centre: args.centre,
            c_arms: args.c_arm.options(),
            iodine_per_mm: args.iodine,
        }),
        volumes_every: (!args.no_volumes).then_some(args.volumes_every),
    };
    let runs = args.runs.as_ref().map(|directory| Acquisition {
        directory: directory.clone(),
        frames: args.run_frames,
        panning_mm: args.panning,
        bits: args.bits,
    });
    tell_of_times(options.layout, &options.degradations);
    warn(&write_dataset(&args.out, args.force, |out| make_with_runs(&gpu, &options, runs.as_ref(), out, bar()))?);
    out!("{}", args.out.display());
    global.close_device(&gpu)
}

/// Projects volumes.
pub fn project(global: &GlobalOptions, args: &ProjectArgs) -> Result<()> {
    let gpu = global.open_device()?;
    let options = VolumeOptions {
        volumes: args.volumes.clone(),
        hints: VolumeHints {
            spacing_mm: args.spacing,
            size: args.raw_size,
            raw_type: args.raw_type.clone(),
            centre: args.centre,
        },
        hounsfield: args.hounsfield,
        scale: args.scale,
        vessel_per_mm: args.vessel,
        still: args.still,
        c_arms: args.c_arm.options(),
        size: args.size,
        views: args.views.views()?,
        seed: args.seed,
        degradations: args.degradations.degradations(false),
        layout: args.layout,
    };
    tell_of_times(options.layout, &options.degradations);
    warn(&write_dataset(&args.out, args.force, |out| project_volumes(&gpu, &options, out, bar()))?);
    out!("{}", args.out.display());
    global.close_device(&gpu)
}

/// Imports clinical data.
pub fn import(args: &ImportArgs) -> Result<()> {
    match &args.source {
        ImportSource::Dicom(args) => dicom(args),
        ImportSource::Pictures(args) => picture_args::run(args),
        ImportSource::Rtk(args) => rtk_args::run(args),
    }
}

fn dicom(args: &ImportDicomArgs) -> Result<()> {
    let options = ImportOptions { keep_references: args.keep_references, ..args.reading.options()? };
    let stated = args.reading.stated(args.files.len())?;
    let import = |out: &Path| import_dicom_as_stated(&args.files, &stated, &options, out);
    let notes = write_dataset(&args.out, args.force, import)?;
    notes.iter().for_each(|note| eprintln!("{note}"));
    out!("{}", args.out.display());
    Ok(())
}
