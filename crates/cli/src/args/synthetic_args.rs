//! Options of synthetic data: views, C-arms, degradations.

use crate::args::options::{choice, pair, triple};
use clap::Args;
use nertca_vk::choice::Choice;
use nertca_vk::error::Result;
use nertca_vk::scan::dataset::Layout;
use nertca_vk::scan::gating::BeatScaling;
use nertca_vk_phantom::dataset::Setting;
use nertca_vk_phantom::degradations::{Breathing, Degradations, GeometryError, Rhythm};
use nertca_vk_phantom::degradations::{USUAL_BEATS, USUAL_BREATH_S, USUAL_FRAMES_PER_S};
use nertca_vk_phantom::noise::Photons;
use nertca_vk_phantom::stenosis::Stenosis;
use nertca_vk_phantom::views::{Angles, CArmOptions, PixelPitch, ViewAngles};
use std::num::NonZeroU32;
use std::path::PathBuf;

/// Arguments of `phantom`.
#[derive(Debug, Args)]
pub struct PhantomArgs {
    /// Directory to write.
    pub out: PathBuf,
    /// Replace a dataset that the directory already contains.
    #[arg(short, long)]
    pub force: bool,
    /// Procedural anatomy and C-arm: `small-xcat` (DSD 2500, DSO 450, body of 0.37 of an adult's size), `xcat` (the same with a
    /// body of half an adult's size, as in the authors' volume) or `magix` (DSD 2000, DSO 600).
    #[arg(long, value_parser = choice::<Setting>(), default_value = Setting::SmallXcat.name())]
    pub geometry: Setting,
    /// Columns and rows of the images.
    #[arg(long, default_value_t = 100)]
    pub size: usize,
    /// Number of cardiac phases.
    #[arg(long, default_value_t = 10)]
    pub phases: u32,
    /// Viewing angles.
    #[command(flatten)]
    pub views: ViewAngleArgs,
    /// Seed of shape, noise and degradations.
    #[arg(long, default_value_t = 1)]
    pub seed: u32,
    /// Layout to write: `native` (`dataset.json`), or `nerfca`, the layout of the NeRF-CA and NerT-CA authors.
    #[arg(long, value_parser = choice::<Layout>(), default_value = Layout::Native.name())]
    pub layout: Layout,
    /// Coronary tree instead of the procedural one: .json, centrelines with radii as .vtp (at rest) from VMTK, 3D Slicer or
    /// `tree`, or a .pvd that lists such files of a beat.
    #[arg(long, value_name = "FILE")]
    pub tree: Option<PathBuf>,
    /// Chest CT in Hounsfield units as background of the tree.
    #[arg(long, value_name = "CT", requires = "tree")]
    pub background: Option<PathBuf>,
    /// Put the middle of the tree, over its beat, at the isocentre; the CT moves along.
    #[arg(long, requires = "tree")]
    pub centre: bool,
    /// C-arm with --tree.
    #[command(flatten)]
    pub c_arm: CArmArgs,
    /// Attenuation of filled vessels with --tree, 1/mm.
    #[arg(long, default_value_t = 0.10, value_name = "PER_MM")]
    pub iodine: f64,
    /// Do not write the voxel volumes (`volumes/*.nrrd`).
    #[arg(long)]
    pub no_volumes: bool,
    /// Write the voxel volumes of only the first of every N phases: 3D scores take proportionally less time.
    #[arg(long, value_name = "N", default_value = "1", conflicts_with = "no_volumes")]
    pub volumes_every: NonZeroU32,
    /// Add a catheter of 2 mm (6F) in the aorta to the training views: its tip, in the ostium, moves with the heart, its other
    /// end does not move; it is not part of the masks.
    #[arg(long, help_heading = DEGRADATIONS)]
    pub catheter: bool,
    /// Narrow a vessel: its branch by the name that the tree has (LM, LAD, LCx, D1 and so on in the procedural one), the position of
    /// the least diameter, mm along the branch, the narrowing of the diameter, percent, and the length, mm. May be given several
    /// times; `truth.json` has the lesions.
    #[arg(long, value_name = "BRANCH,POSITION,DIAMETER%,LENGTH", value_parser = stenosis)]
    pub stenosis: Vec<Stenosis>,
    /// Write each training view also as a run without ECG, as a cath lab makes it, into this directory: a DICOM file, a folder of pictures,
    /// and `truth.json`. Contrast agent arrives and leaves, and degradations act on the runs; the dataset is then what is true.
    #[arg(long, value_name = "DIR")]
    pub runs: Option<PathBuf>,
    /// Frames of each run.
    #[arg(long, value_name = "N", default_value_t = 45, requires = "runs")]
    pub run_frames: u32,
    /// Panning of the table within each run, mm along the patient.
    #[arg(long, value_name = "MM", default_value_t = 0.0, requires = "runs")]
    pub panning: f64,
    /// Bits of a pixel of the runs.
    #[arg(long, default_value_t = 12, requires = "runs")]
    pub bits: u32,
    /// Degradations that occur in a cath lab.
    #[command(flatten)]
    pub degradations: DegradationArgs,
}

/// Arguments of `project`.
#[derive(Debug, Args)]
pub struct ProjectArgs {
    /// Volumes, one per phase in order: .npy .nii .nii.gz .nrrd .mha or raw binaries.
    #[arg(required = true, value_name = "VOLUME")]
    pub volumes: Vec<PathBuf>,
    /// Directory to write.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Replace a dataset that the directory already contains.
    #[arg(short, long)]
    pub force: bool,
    /// Columns and rows of the images.
    #[arg(long, default_value_t = 200)]
    pub size: usize,
    /// Viewing angles.
    #[command(flatten)]
    pub views: ViewAngleArgs,
    /// C-arm.
    #[command(flatten)]
    pub c_arm: CArmArgs,
    /// Values are Hounsfield units, not attenuation per mm.
    #[arg(long)]
    pub hounsfield: bool,
    /// Multiply values by this after reading.
    #[arg(long, default_value_t = 1.0)]
    pub scale: f32,
    /// Voxels at or above this attenuation per mm are vessel, for the masks and the Dice threshold.
    #[arg(long, value_name = "PER_MM")]
    pub vessel: Option<f64>,
    /// The object does not move: one volume, and a dataset that says so (`"still": true`).
    #[arg(long)]
    pub still: bool,
    /// Voxel spacing of .npy and raw volumes, mm.
    #[arg(long, value_name = "X,Y,Z", value_parser = triple::<f64>)]
    pub spacing: Option<[f64; 3]>,
    /// Size of raw volumes, voxels.
    #[arg(long, value_name = "X,Y,Z", value_parser = triple::<usize>)]
    pub raw_size: Option<[usize; 3]>,
    /// Element type of raw volumes: f32, f64, i16, u16 or u8, little endian.
    #[arg(long, value_name = "TYPE")]
    pub raw_type: Option<String>,
    /// Put the centre of each volume at the isocentre.
    #[arg(long)]
    pub centre: bool,
    /// Seed of noise and degradations.
    #[arg(long, default_value_t = 1)]
    pub seed: u32,
    /// Layout to write: `native` (`dataset.json`), or `nerfca`, the layout of the NeRF-CA and NerT-CA authors.
    #[arg(long, value_parser = choice::<Layout>(), default_value = Layout::Native.name())]
    pub layout: Layout,
    /// Degradations that occur in a cath lab.
    #[command(flatten)]
    pub degradations: DegradationArgs,
}

/// Heading of [`DegradationArgs`] in the help.
const DEGRADATIONS: &str = "Degradations (of the training views; true values in truth.json)";

/// Degradations of synthetic data, as they occur in a cath lab.
#[derive(Debug, Args)]
#[command(next_help_heading = DEGRADATIONS)]
pub struct DegradationArgs {
    /// Standard deviations of the stated geometry's errors: of both angles, degrees, and of the patient's position along each
    /// axis, mm. Images are made with the true geometry.
    #[arg(long, value_name = "DEG,MM", allow_hyphen_values = true, value_parser = geometry_error)]
    pub geometry_error: Option<GeometryError>,
    /// The heart moves with breathing: displacement along the body, peak to peak, mm, and the length of a breath, seconds (4 by
    /// default). Each run begins at a random moment of the breath; the background does not move.
    #[arg(long, value_name = "MM[,PERIOD_S]", allow_hyphen_values = true, value_parser = breathing)]
    pub breathing: Option<Breathing>,
    /// The diaphragm moves with breathing as well, and with a CT or with volumes also the lower front of the chest.
    #[arg(long, requires = "breathing")]
    pub breathing_background: bool,
    /// Photon noise of all views: photons per pixel of the unattenuated beam, before the patient.
    #[arg(long, value_name = "N", allow_hyphen_values = true, conflicts_with = "detector_photons")]
    pub photons: Option<f64>,
    /// Photon noise of all views: photons per pixel at the detector, behind the patient, as the mean over each image.
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    pub detector_photons: Option<f64>,
    /// Standard deviation of the contrast density between runs, percent. Within a run it varies half as much.
    #[arg(long, value_name = "PERCENT", default_value_t = 0.0, allow_hyphen_values = true)]
    pub contrast_variation: f64,
    /// Seconds from the first image of a run, when contrast enters the vessels, until it reaches their ends. By default,
    /// vessels are full from the start.
    #[arg(long, value_name = "S", default_value_t = 0.0, allow_hyphen_values = true)]
    pub inflow: f64,
    /// Beats per minute, one for all training views or one for each: images are taken at --fps from a random moment of the
    /// beat, and each phase gets the nearest image by --gating, if one is nearer than half a phase. By default, images are
    /// taken at regular phases.
    #[arg(long, value_name = "BPM[,BPM...]", value_delimiter = ',', allow_hyphen_values = true)]
    pub heart_rate: Vec<f64>,
    /// Images per second, e.g. 7.5, 15 or 30.
    #[arg(long, default_value_t = USUAL_FRAMES_PER_S, requires = "heart_rate", allow_hyphen_values = true)]
    pub fps: f64,
    /// Length of each run, beats: contrast fills the vessels for about three beats.
    #[arg(long, default_value_t = USUAL_BEATS, requires = "heart_rate")]
    pub beats: u32,
    /// Conversion of time to phase: `two-segment` (systole keeps its length, diastole takes the rest) or `linear`.
    #[arg(long, value_parser = choice::<BeatScaling>(), default_value = BeatScaling::TwoSegment.name(),
        requires = "heart_rate")]
    pub gating: BeatScaling,
    /// A blade on one side hides about this share (0 to 0.9) of the moving vessels of each view.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, allow_hyphen_values = true)]
    pub collimate: f64,
}

impl DegradationArgs {
    /// Returns the degradations that were requested.
    pub fn degradations(&self, catheter: bool) -> Degradations {
        let background = self.breathing_background;
        let open = self.photons.map(Photons::Unattenuated);
        Degradations {
            geometry_error: self.geometry_error,
            breathing: self.breathing.map(|breathing| Breathing { background, ..breathing }),
            photons: open.or(self.detector_photons.map(Photons::Detector)),
            contrast_variation: self.contrast_variation / 100.0,
            inflow_s: self.inflow,
            rhythm: (!self.heart_rate.is_empty()).then(|| Rhythm {
                beats_per_min: self.heart_rate.clone(),
                frames_per_s: self.fps,
                beats: self.beats,
                gating: self.gating,
            }),
            collimated_share: self.collimate,
            catheter,
        }
    }
}

/// Options of the views of synthetic data.
#[derive(Debug, Args)]
pub struct ViewAngleArgs {
    /// Number of training views: the paper's 3, 4 or 9.
    #[arg(long, default_value_t = 4, conflicts_with = "angles")]
    pub views: u32,
    /// Primary and secondary angles of the training views, degrees (LAO and cranial positive), instead of the paper's.
    #[arg(long, value_name = "P,S[;P,S...]", allow_hyphen_values = true, value_parser = view_angles)]
    pub angles: Option<AngleList>,
    /// Validation views, or `none`, instead of the paper's (without those of the paper's within 15 degrees of --angles).
    #[arg(long, value_name = "P,S[;P,S...]", allow_hyphen_values = true, value_parser = test_angles)]
    pub test_angles: Option<AngleList>,
}

/// Angles of several views.
#[derive(Debug, Clone)]
pub struct AngleList(pub Vec<Angles>);

impl ViewAngleArgs {
    /// Returns the views that were requested.
    pub fn views(&self) -> Result<ViewAngles> {
        let validation = self.test_angles.as_ref().map(|list| list.0.as_slice());
        let mut views = match &self.angles {
            Some(list) => ViewAngles::given(&list.0, validation)?,
            None => ViewAngles::published(self.views)?,
        };
        if let Some(validation) = validation {
            views.validation = validation.to_vec();
        }
        Ok(views)
    }
}

/// C-arms of synthetic data: one value for all views, or one for each, with the training views first.
#[derive(Debug, Args)]
pub struct CArmArgs {
    /// Distance from source to isocentre, mm: one for all views, or one for each (training first, then validation).
    #[arg(long, default_value = "750", value_name = "MM[,MM...]", value_delimiter = ',')]
    pub sod: Vec<f64>,
    /// Distance from source to detector, mm: one for all views, or one for each.
    #[arg(long, default_value = "1100", value_name = "MM[,MM...]", value_delimiter = ',')]
    pub sid: Vec<f64>,
    /// Field of view at the isocentre, mm.
    #[arg(long, default_value_t = 160.0, value_name = "MM")]
    pub fov: f64,
    /// Pixel pitch on the detector along columns and rows, mm, instead of --fov: one number or two.
    #[arg(long, value_name = "MM[,MM]", value_parser = pitch, conflicts_with = "fov")]
    pub pixel: Option<[f64; 2]>,
    /// Offset of the detector's centre along columns and rows, mm: one for all views, or one for each.
    #[arg(long, default_value = "0,0", value_name = "U,V[;U,V...]", allow_hyphen_values = true, value_delimiter = ';',
        value_parser = offset)]
    pub offset: Vec<[f64; 2]>,
}

impl CArmArgs {
    /// Tells whether no option was given.
    pub fn is_default(&self) -> bool {
        let at_rest = self.offset == [[0.0; 2]] && self.pixel.is_none();
        self.sod == [750.0] && self.sid == [1100.0] && self.fov == 160.0 && at_rest
    }

    /// Returns the C-arms that were requested.
    pub fn options(&self) -> CArmOptions {
        CArmOptions {
            sod_mm: self.sod.clone(),
            sid_mm: self.sid.clone(),
            pixel: self.pixel.map_or(PixelPitch::FieldOfView(self.fov), PixelPitch::Detector),
            offset_mm: self.offset.clone(),
        }
    }
}

/// Parses `DEG,MM`.
fn geometry_error(text: &str) -> std::result::Result<GeometryError, String> {
    let [angle_deg, position_mm] = pair(text).ok_or("degrees and mm are needed, written as DEG,MM")?;
    Ok(GeometryError { angle_deg, position_mm })
}

/// Parses `BRANCH,POSITION,DIAMETER%,LENGTH`; the name of the branch may contain commas.
fn stenosis(text: &str) -> std::result::Result<Stenosis, String> {
    let problem = "a branch, a position in mm, a narrowing in percent and a length in mm are needed, written as \
                   BRANCH,POSITION,DIAMETER%,LENGTH, such as LAD,20,60,8";
    let mut parts = text.rsplitn(4, ',');
    let mut number = || parts.next()?.trim().trim_end_matches('%').parse().ok();
    let numbers = number().zip(number()).zip(number());
    let ((length_mm, percent), position_mm) = numbers.ok_or(problem)?;
    let branch = parts.next().ok_or(problem)?.trim().to_owned();
    Ok(Stenosis { branch, position_mm, percent, length_mm })
}

/// Parses `MM` or `MM,PERIOD_S`.
fn breathing(text: &str) -> std::result::Result<Breathing, String> {
    let both = pair(text).or_else(|| Some([text.trim().parse().ok()?, USUAL_BREATH_S]));
    let [peak_to_peak_mm, period_s] =
        both.ok_or("mm are needed, written as MM, or mm and seconds, written as MM,PERIOD_S")?;
    Ok(Breathing { peak_to_peak_mm, period_s, background: false })
}

/// Parses a detector offset, `U,V`.
fn offset(text: &str) -> std::result::Result<[f64; 2], String> {
    pair(text).ok_or_else(|| "two lengths in mm are needed, written as U,V".to_owned())
}

/// Parses `P,S[;P,S...]`.
pub(crate) fn view_angles(text: &str) -> std::result::Result<AngleList, String> {
    let view = |view: &str| match pair(view) {
        Some([primary_deg, secondary_deg]) => Ok(Angles { primary_deg, secondary_deg }),
        None => Err(format!(
            "`{view}` is not of the form P,S (primary and secondary angle); several views are written as P,S;P,S"
        )),
    };
    text.split(';').map(view).collect::<std::result::Result<_, _>>().map(AngleList)
}

/// Parses `P,S[;P,S...]`, or `none`.
fn test_angles(text: &str) -> std::result::Result<AngleList, String> {
    if text == "none" { Ok(AngleList(Vec::new())) } else { view_angles(text) }
}

/// Parses one length for both directions, or two lengths.
pub(crate) fn pitch(text: &str) -> std::result::Result<[f64; 2], String> {
    let parts: Vec<f64> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    match parts[..] {
        [x] if x > 0.0 => Ok([x, x]),
        [x, y] if x > 0.0 && y > 0.0 => Ok([x, y]),
        _ => Err("one or two positive lengths in mm are needed".into()),
    }
}
