//! `import pictures`: views as folders of pictures, whose geometry is given by options or by a file.

use crate::args::dicom_args::{RunArgs, for_each};
use crate::args::synthetic_args::{AngleList, pitch, view_angles};
use crate::output::write_dataset;
use clap::{Args, ValueEnum};
use nertca_vk::error::{Error, Result};
use nertca_vk::geometry::CArm;
use nertca_vk_import::angiograms::{Gating, ImportOptions};
use nertca_vk_import::dicom::Relationship;
use nertca_vk_import::intake::import_pictures;
use nertca_vk_import::pictures::{PictureView, PixelMeaning};
use nertca_vk_import::views_file::{self, ViewsFile};
use std::path::{Path, PathBuf};

/// Arguments of `import pictures`.
#[derive(Debug, Args)]
pub struct ImportPicturesArgs {
    /// Views: a folder with one picture per frame (.png, .jpg or .tif, in the order of the numbers in their names), or a file
    /// with one or more frames.
    #[arg(required_unless_present = "geometry", value_name = "DIR_OR_FILE")]
    pub views: Vec<PathBuf>,
    /// Directory to write.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Replace a dataset that the directory already contains.
    #[arg(short, long)]
    pub force: bool,
    /// TOML file with the views, their geometry and their times, instead of these options (see docs/formats.md).
    #[arg(long, value_name = "FILE", conflicts_with_all = ["views", "angles", "sid", "sod", "pixel", "fps"])]
    pub geometry: Option<PathBuf>,
    /// Primary and secondary angle of each view, degrees (LAO and cranial positive).
    #[arg(long, required_unless_present = "geometry", value_name = "P,S;P,S...", allow_hyphen_values = true, value_parser = view_angles)]
    pub angles: Option<AngleList>,
    /// Distance from source to detector, mm: one for all views, or one for each.
    #[arg(long, required_unless_present = "geometry", value_name = "MM[,MM...]", value_delimiter = ',')]
    pub sid: Vec<f64>,
    /// Distance from source to isocentre, mm: one for all views, or one for each.
    #[arg(long, required_unless_present = "geometry", value_name = "MM[,MM...]", value_delimiter = ',')]
    pub sod: Vec<f64>,
    /// Pitch of the pictures' pixels on the detector along columns and rows, mm: one number or two.
    #[arg(long, required_unless_present = "geometry", value_name = "MM[,MM]", value_parser = pitch)]
    pub pixel: Option<[f64; 2]>,
    /// Frames per second: one for all views, or one for each. Needed unless the object is still or --phase-list is given.
    #[arg(long, value_name = "PER_S[,PER_S...]", value_delimiter = ',')]
    pub fps: Vec<f64>,
    /// Meaning of pixel values: `display` (as viewers export them: taken as logarithmic, with an unknown scale), `log`
    /// (logarithmic in intensity) or `linear` (proportional to intensity).
    #[arg(long, value_enum, default_value_t = Meaning::Display)]
    pub intensity: Meaning,
    /// Pixel value without absorption; by default the largest one that the files can store.
    #[arg(long, value_name = "VALUE")]
    pub white: Option<f64>,
    /// Vessels are brighter than their surroundings.
    #[arg(long)]
    pub bright_vessels: bool,
    /// Letters are burnt into the frames: pixels that are black or white in all frames are filled from beside them.
    #[arg(long)]
    pub burnt_in_text: bool,
    /// Options of runs of any source.
    #[command(flatten)]
    pub runs: RunArgs,
}

/// Meaning of pixel values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Meaning {
    /// Display grey values.
    Display,
    /// Logarithmic in intensity.
    Log,
    /// Proportional to intensity.
    Linear,
}

/// Imports pictures.
pub fn run(args: &ImportPicturesArgs) -> Result<()> {
    let mut options = args.runs.options()?;
    let (views, gatings) = match &args.geometry {
        None => (views(args)?, args.runs.gatings(args.views.len())?),
        Some(file) => of_file(file, &args.runs, &mut options)?,
    };
    let meaning = PixelMeaning {
        relationship: match args.intensity {
            Meaning::Display => Relationship::Display,
            Meaning::Log => Relationship::Log,
            Meaning::Linear => Relationship::Linear,
        },
        white: args.white,
        bright_vessels: args.bright_vessels,
        burnt_in_text: args.burnt_in_text,
    };
    let notes = write_dataset(&args.out, args.force, |out| import_pictures(&views, &gatings, &meaning, &options, out))?;
    notes.iter().for_each(|note| eprintln!("{note}"));
    out!("{}", args.out.display());
    Ok(())
}

/// Returns the views that the options state.
fn views(args: &ImportPicturesArgs) -> Result<Vec<PictureView>> {
    let n = args.views.len();
    let angles = for_each("--angles", args.angles.as_ref().map_or(&[], |list| &list.0), n)?;
    let (sid, sod) = (for_each("--sid", &args.sid, n)?, for_each("--sod", &args.sod, n)?);
    let fps = for_each("--fps", &args.fps, n)?;
    let view = |i: usize| PictureView {
        path: args.views[i].clone(),
        c_arm: CArm {
            primary_deg: angles[i].map_or(0.0, |angles| angles.primary_deg),
            secondary_deg: angles[i].map_or(0.0, |angles| angles.secondary_deg),
            sid_mm: sid[i].unwrap_or_default(),
            sod_mm: sod[i].unwrap_or_default(),
            pixel_mm: args.pixel.unwrap_or_default(),
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        },
        frames_per_s: fps[i],
    };
    Ok((0..n).map(view).collect())
}

/// Returns the views of a file and the sources of their phases; options that state the phases of runs take precedence over the file.
fn of_file(
    file: &Path,
    runs: &RunArgs,
    options: &mut ImportOptions,
) -> Result<(Vec<PictureView>, Vec<Option<Gating>>)> {
    let ViewsFile { views, gatings, still } = views_file::read(file)?;
    let given = runs.gatings(views.len())?;
    if still {
        if given.iter().any(Option::is_some) || runs.gate_by_images {
            return Err(Error::data(file, "still", "is true, but options state the phases of a beat"));
        }
        options.gating = Gating::Still;
    }
    if runs.still || runs.gate_by_images {
        return Ok((views, given));
    }
    let gatings = gatings.into_iter().zip(given).map(|(of_file, given)| given.or(of_file)).collect();
    Ok((views, gatings))
}
