//! `phantom`, `project` and `import`.

use super::args::{Cli, ImportArgs, ImportDicomArgs, ImportSource, PhantomArgs, ProjectArgs};
use indicatif::{ProgressBar, ProgressStyle};
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::formats::volume::VolumeHints;
use nertca_vk::import::angiograms::{Gating, ImportOptions, import_dicom};
use nertca_vk::phantom::dataset::{Anatomy, PhantomOptions, VolumeOptions, make, project_volumes};
use nertca_vk::scan::gating::RPeaks;
use std::path::Path;

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
        (true, ..) => Gating::Still,
        (_, Some(file), ..) => Gating::RPeaks(RPeaks::new(&list::<f64>(file)?)?),
        (_, _, Some(rate), _) => Gating::HeartRate(rate),
        (_, _, _, Some(file)) => Gating::Phases(list(file)?),
        _ => Gating::Ecg,
    };
    let options = ImportOptions {
        phases: args.phases,
        gating,
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
