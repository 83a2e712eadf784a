//! `phantom`, `project` and `import`.

use super::args::{Cli, choice};
use super::synthetic_args::{PhantomArgs, ProjectArgs, pitch};
use clap::{Args, Subcommand};
use indicatif::{ProgressBar, ProgressStyle};
use nertca_vk::choice::Choice;
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::formats::volume::VolumeHints;
use nertca_vk::import::angiograms::{Gating, ImportOptions, import_dicom};
use nertca_vk::phantom::dataset::{Anatomy, PhantomOptions, VolumeOptions, make, project_volumes};
use nertca_vk::scan::gating::{BeatScaling, RPeaks};
use std::path::{Path, PathBuf};

/// `import`.
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// What to import.
    #[command(subcommand)]
    pub source: ImportSource,
}

/// What can be imported.
#[derive(Debug, Subcommand)]
pub enum ImportSource {
    /// X-ray angiography runs (DICOM XA or RF, multi-frame), one file per view.
    Dicom(ImportDicomArgs),
}

/// `import dicom`.
#[derive(Debug, Args)]
pub struct ImportDicomArgs {
    /// One file per view.
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// Directory to make.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Cardiac phases.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub phases: u32,
    /// Nothing moves: average each run. Phase 0 is the object, phase 1 what it looks like without vessels.
    #[arg(long, conflicts_with_all = ["r_peaks", "heart_rate", "phase_list"])]
    pub still: bool,
    /// R-peaks in seconds from the first frame, one per line, instead of the files' ECG.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["heart_rate", "phase_list"])]
    pub r_peaks: Option<PathBuf>,
    /// Beats per minute of a steady heart with an R-peak at the first frame.
    #[arg(long, value_name = "PER_MIN", conflicts_with = "phase_list")]
    pub heart_rate: Option<f64>,
    /// No ECG: find the beat of each run in how its vessels move. The heart is taken to be steady; one and a half beats must be
    /// filled with contrast.
    #[arg(long, conflicts_with_all = ["still", "r_peaks", "heart_rate", "phase_list"])]
    pub gate_by_images: bool,
    /// How times between R-peaks become phases.
    #[arg(long, value_parser = choice::<BeatScaling>(), default_value = BeatScaling::default().name())]
    pub beat_scaling: BeatScaling,
    /// A phase from 0 for each selected frame, one per line, the same for all runs; a frame may lie between two, as 3.4.
    #[arg(long, value_name = "FILE")]
    pub phase_list: Option<PathBuf>,
    /// Frames of each run, from 1; those filled with contrast by default.
    #[arg(long, value_name = "FIRST-LAST", value_parser = frame_range)]
    pub frames: Option<std::ops::RangeInclusive<usize>>,
    /// Pixel pitch on the detector along columns and rows, mm: one number or two.
    #[arg(long, value_name = "MM[,MM]", value_parser = pitch)]
    pub pixel_spacing: Option<[f64; 2]>,
    /// Longest side of the images, pixels: larger ones are averaged down.
    #[arg(long)]
    pub size: Option<usize>,
    /// Depth searched before and behind the isocentre, mm.
    #[arg(long, default_value_t = 100.0, value_name = "MM")]
    pub depth: f64,
}

/// Parses `FIRST-LAST`.
fn frame_range(text: &str) -> std::result::Result<std::ops::RangeInclusive<usize>, String> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    match (first.trim().parse(), last.trim().parse()) {
        (Ok(first), Ok(last)) if first <= last => Ok(first..=last),
        _ => Err("write it as FIRST-LAST, as in 5-12".into()),
    }
}

/// A progress bar for work whose length is known as it goes.
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

/// Makes a phantom.
pub fn phantom(cli: &Cli, args: &PhantomArgs) -> Result<()> {
    if args.tree.is_none() && !args.c_arm.is_default() {
        let problem = "--sod, --sid, --fov, --pixel and --offset are for --tree; a published set-up has its own C-arm";
        return Err(Error::config("--tree", "none", problem));
    }
    let gpu = cli.open_device()?;
    let options = PhantomOptions {
        setting: args.geometry,
        size: args.size,
        phases: args.phases,
        views: args.views.views()?,
        seed: args.seed,
        degradations: args.degradations.degradations(args.catheter),
        layout: args.layout,
        anatomy: args.tree.as_ref().map(|tree| Anatomy {
            tree: tree.clone(),
            background: args.background.clone(),
            c_arms: args.c_arm.options(),
            iodine_per_mm: args.iodine,
        }),
        volumes: !args.no_volumes,
    };
    make(&gpu, &options, &args.out, bar())?;
    out!("{}", args.out.display());
    cli.close_device(&gpu)
}

/// Projects volumes.
pub fn project(cli: &Cli, args: &ProjectArgs) -> Result<()> {
    let gpu = cli.open_device()?;
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
        c_arms: args.c_arm.options(),
        size: args.size,
        views: args.views.views()?,
        seed: args.seed,
        degradations: args.degradations.degradations(false),
        layout: args.layout,
    };
    project_volumes(&gpu, &options, &args.out, bar())?;
    out!("{}", args.out.display());
    cli.close_device(&gpu)
}

/// Imports clinical data.
pub fn import(args: &ImportArgs) -> Result<()> {
    match &args.source {
        ImportSource::Dicom(args) => dicom(args),
    }
}

/// One value per line; what follows a `#` is left out.
fn list<T: std::str::FromStr>(path: &Path) -> Result<Vec<T>> {
    let text =
        String::from_utf8(files::read_limited(path, 1 << 20)?).map_err(|e| Error::data(path, "text", e.to_string()))?;
    let lines = text.lines().map(|l| l.split('#').next().unwrap_or_default().trim()).enumerate();
    lines
        .filter(|(_, line)| !line.is_empty())
        .map(|(i, line)| {
            line.parse().map_err(|_| Error::data(path, format!("line {}", i + 1), format!("`{line}` is not a number")))
        })
        .collect()
}

fn dicom(args: &ImportDicomArgs) -> Result<()> {
    let gating = match (args.still, &args.r_peaks, args.heart_rate, &args.phase_list) {
        _ if args.gate_by_images => Gating::Images,
        (true, ..) => Gating::Still,
        (_, Some(file), ..) => Gating::RPeaks(RPeaks::new(&list::<f64>(file)?)?),
        (_, _, Some(rate), _) => Gating::HeartRate(rate),
        (_, _, _, Some(file)) => Gating::Phases(list(file)?),
        _ => Gating::Ecg,
    };
    let options = ImportOptions {
        phases: args.phases,
        gating,
        scaling: args.beat_scaling,
        frames: args.frames.clone(),
        pixel_mm: args.pixel_spacing,
        size: args.size,
        depth_half_extent_mm: args.depth,
    };
    if !(args.depth.is_finite() && args.depth > 0.0) {
        return Err(Error::config("depth", args.depth, "is not a positive length in mm"));
    }
    import_dicom(&args.files, &options, &args.out)?.iter().for_each(|note| eprintln!("{note}"));
    out!("{}", args.out.display());
    Ok(())
}
