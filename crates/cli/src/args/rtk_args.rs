//! `import rtk`: projections and a geometry of the Reconstruction Toolkit.

use crate::args::dicom_args::list;
use crate::output::write_dataset;
use clap::Args;
use nertca_vk::error::{Error, Result};
use nertca_vk::scan::rtk::{RtkOptions, import};
use std::path::PathBuf;

/// Arguments of `import rtk`.
#[derive(Debug, Args)]
pub struct ImportRtkArgs {
    /// Geometry (`RTKThreeDCircularGeometry`, XML) with one projection for each image.
    #[arg(value_name = "GEOMETRY")]
    pub geometry: PathBuf,
    /// Stack of projections, line integrals: .mha or .nrrd.
    #[arg(value_name = "PROJECTIONS")]
    pub projections: PathBuf,
    /// Directory to write.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Replace a dataset that the directory already contains.
    #[arg(short, long)]
    pub force: bool,
    /// Number of cardiac phases.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub phases: u32,
    /// Phase (from 0) of each projection, one per line; a projection may lie between two phases, e.g. 3.4.
    #[arg(long, value_name = "FILE", conflicts_with = "still")]
    pub phase_list: Option<PathBuf>,
    /// The object does not move. The dataset states it, and results have one phase.
    #[arg(long)]
    pub still: bool,
    /// Depth range to reconstruct in front of and behind the isocentre, mm.
    #[arg(long, default_value_t = 100.0, value_name = "MM")]
    pub depth: f64,
}

/// Imports projections.
pub fn run(args: &ImportRtkArgs) -> Result<()> {
    if !(args.depth.is_finite() && args.depth > 0.0) {
        return Err(Error::config("depth", args.depth, "is not a positive length in mm"));
    }
    if args
        .projections
        .extension()
        .is_none_or(|end| !end.eq_ignore_ascii_case("mha") && !end.eq_ignore_ascii_case("nrrd"))
    {
        return Err(Error::config("PROJECTIONS", args.projections.display(), "is neither .mha nor .nrrd"));
    }
    if args.phase_list.is_none() && !args.still {
        let problem =
            "a geometry of RTK has no times: give a phase for each projection, or --still for an object at rest";
        return Err(Error::config("--phase-list", "none", problem));
    }
    let times = args.phase_list.as_ref().map(|file| list::<f64>(file)).transpose()?;
    let options = RtkOptions { phases: args.phases, times, depth_half_extent_mm: args.depth };
    let views = write_dataset(&args.out, args.force, |out| import(&args.geometry, &args.projections, &options, out))?;
    eprintln!("{views} views; the axes of RTK are taken as left, superior and anterior");
    out!("{}", args.out.display());
    Ok(())
}
