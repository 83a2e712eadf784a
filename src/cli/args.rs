//! What can be typed.

use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, Parser, Subcommand};
use nertca_vk::choice::Choice;
use nertca_vk::config::{CalibrateMode, Config, Preset};
use nertca_vk::error::Result;
use nertca_vk::export::volumes::Format;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk::kernels::tuning::{Layers, Tuning};
use nertca_vk::model::component::Component;
use nertca_vk::phantom::dataset::Setting;
use nertca_vk::phantom::degradations::{Breathing, Degradations, GeometryError, Rhythm, USUAL_BREATH_S};
use nertca_vk::phantom::noise::Photons;
use nertca_vk::phantom::views::{Angles, CArmOptions, PixelPitch, ViewAngles};
use nertca_vk::render::quantity::Projection;
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::scan::gating::BeatScaling;
use nertca_vk::train::calibrate;
use std::path::PathBuf;

/// 4D reconstruction of the beating coronary arteries from 3 or 4 X-ray angiography views.
#[derive(Debug, Parser)]
#[command(version, about, arg_required_else_help = true)]
pub struct Cli {
    /// Vulkan device: index, part of the name, or UUID (see `devices`); the best one by default.
    #[arg(long, global = true, value_name = "DEVICE")]
    pub device: Option<String>,
    /// Path of the network's layers: `f32`, or `matrices` (cooperative matrices: f16 operands, f32 sums); by default
    /// the faster one on the device.
    #[arg(long, global = true, value_parser = choice::<Layers>(), value_name = "PATH")]
    pub layers: Option<Layers>,
    /// Turn the Vulkan validation layers on (slow; messages make the program fail).
    #[arg(long, global = true)]
    pub validate: bool,
    /// Say more on stderr.
    #[arg(short, long, global = true)]
    pub verbose: bool,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// Commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// List Vulkan devices, their limits and the code paths they get.
    Devices(DevicesArgs),
    /// Make a synthetic dataset with exact masks.
    Phantom(PhantomArgs),
    /// Project voxel volumes, one per phase, into a dataset.
    Project(ProjectArgs),
    /// Import clinical data as a dataset.
    Import(ImportArgs),
    /// Reconstruct a dataset into a run directory.
    Train(TrainArgs),
    /// Score a run on the views it has not seen.
    Eval(EvalArgs),
    /// Render a run from any angle at any phase.
    Render(RenderArgs),
    /// Look at a run in a browser: turn the C-arm with the mouse while the beat plays.
    View(ViewArgs),
    /// Export volumes or vessel surfaces of a run for other tools.
    Export(ExportArgs),
    /// Vessels of a run as trees: centrelines with radii in mm, followed over the beat.
    Tree(TreeArgs),
    /// Correct views that disagree, from the angiograms alone.
    Calibrate(CalibrateArgs),
    /// Convert a dataset between the native and the authors' layout.
    Convert(ConvertArgs),
    /// Measure iterations, passes and renderings against device limits and the 37 minutes of the paper.
    Bench(BenchArgs),
    /// Tell whether a dataset makes sense, and which of the usual mistakes it has.
    Check(CheckArgs),
    /// Describe a dataset or a run.
    Info(InfoArgs),
    /// Print shell completions.
    Completions(CompletionsArgs),
}

/// `devices`.
#[derive(Debug, Args)]
pub struct DevicesArgs {
    /// JSON instead of text.
    #[arg(long)]
    pub json: bool,
}

/// `phantom`.
#[derive(Debug, Args)]
pub struct PhantomArgs {
    /// Directory to make.
    pub out: PathBuf,
    /// C-arm and volume of a published set-up: `xcat` (DSD 2500, DSO 450) or `magix` (DSD 2000, DSO 600).
    #[arg(long, value_parser = choice::<Setting>(), default_value = Setting::Xcat.name())]
    pub geometry: Setting,
    /// Columns and rows of the images.
    #[arg(long, default_value_t = 100)]
    pub size: usize,
    /// Cardiac phases.
    #[arg(long, default_value_t = 10)]
    pub phases: u32,
    /// From where it is seen.
    #[command(flatten)]
    pub views: ViewAngleArgs,
    /// Seed of shape, noise and degradations.
    #[arg(long, default_value_t = 1)]
    pub seed: u32,
    /// Layout to write: `native` (`dataset.json`), or `nerfca`, that of the NeRF-CA and NerT-CA authors.
    #[arg(long, value_parser = choice::<Layout>(), default_value = Layout::Native.name())]
    pub layout: Layout,
    /// Coronary tree as JSON instead of the procedural one.
    #[arg(long, value_name = "FILE")]
    pub tree: Option<PathBuf>,
    /// Chest CT in Hounsfield units behind the tree.
    #[arg(long, value_name = "CT", requires = "tree")]
    pub background: Option<PathBuf>,
    /// C-arm with --tree.
    #[command(flatten)]
    pub c_arm: CArmArgs,
    /// Attenuation of filled vessels with --tree, 1/mm.
    #[arg(long, default_value_t = 0.10, value_name = "PER_MM")]
    pub iodine: f64,
    /// Do not write the voxel volumes (`volumes/*.nrrd`).
    #[arg(long)]
    pub no_volumes: bool,
    /// A catheter of 2 mm (6F) in the aorta of the training views: its tip, in the ostium, goes with the heart, its other
    /// end is still; not part of the masks.
    #[arg(long, help_heading = DEGRADATIONS)]
    pub catheter: bool,
    /// What a cath lab's angiograms have.
    #[command(flatten)]
    pub degradations: DegradationArgs,
}

/// `project`.
#[derive(Debug, Args)]
pub struct ProjectArgs {
    /// Volumes, one per phase in order: .npy .nii .nii.gz .nrrd .mha or raw binaries.
    #[arg(required = true, value_name = "VOLUME")]
    pub volumes: Vec<PathBuf>,
    /// Directory to make.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Columns and rows of the images.
    #[arg(long, default_value_t = 200)]
    pub size: usize,
    /// From where it is seen.
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
    /// Layout to write: `native` (`dataset.json`), or `nerfca`, that of the NeRF-CA and NerT-CA authors.
    #[arg(long, value_parser = choice::<Layout>(), default_value = Layout::Native.name())]
    pub layout: Layout,
    /// What a cath lab's angiograms have.
    #[command(flatten)]
    pub degradations: DegradationArgs,
}

/// Heading of [`DegradationArgs`] in the help.
const DEGRADATIONS: &str = "Degradations (of the training views; true values in truth.json)";

/// What makes synthetic data worse, as a cath lab's are.
#[derive(Debug, Args)]
#[command(next_help_heading = DEGRADATIONS)]
pub struct DegradationArgs {
    /// Standard deviations of the stated geometry's errors: of both angles, degrees, and of the patient's position along each
    /// axis, mm. Images are made with the true geometry.
    #[arg(long, value_name = "DEG,MM", allow_hyphen_values = true, value_parser = geometry_error)]
    pub geometry_error: Option<GeometryError>,
    /// The heart breathes: its way along the body, peak to peak, mm, and the length of a breath, seconds (4 by default). Each
    /// run begins anywhere in the breath; the background stays.
    #[arg(long, value_name = "MM[,PERIOD_S]", allow_hyphen_values = true, value_parser = breathing)]
    pub breathing: Option<Breathing>,
    /// The diaphragm breathes, too, and with a CT or with volumes the lower front of the chest.
    #[arg(long, requires = "breathing")]
    pub breathing_background: bool,
    /// Photon noise, of all views: photons per pixel of the open beam, before the patient.
    #[arg(long, value_name = "N", allow_hyphen_values = true, conflicts_with = "detector_photons")]
    pub photons: Option<f64>,
    /// Photon noise, of all views: photons per pixel at the detector, behind the patient, as the mean over each image.
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    pub detector_photons: Option<f64>,
    /// Contrast density differs between runs: its standard deviation, percent. Within a run it drifts half as much.
    #[arg(long, value_name = "PERCENT", default_value_t = 0.0, allow_hyphen_values = true)]
    pub contrast_variation: f64,
    /// Beats per minute, one for all training views or one for each: images are taken at --fps from anywhere in the beat, and
    /// each phase gets the nearest image by --gating, where one is nearer than half a phase. Regular phases without.
    #[arg(long, value_name = "BPM[,BPM...]", value_delimiter = ',', allow_hyphen_values = true)]
    pub heart_rate: Vec<f64>,
    /// Images per second, as 7.5, 15 or 30.
    #[arg(long, default_value_t = 15.0, requires = "heart_rate", allow_hyphen_values = true)]
    pub fps: f64,
    /// Length of each run, beats: contrast fills the vessels for about three.
    #[arg(long, default_value_t = 3, requires = "heart_rate")]
    pub beats: u32,
    /// How time becomes phase: `two-segment` (systole keeps its length, diastole takes the rest) or `linear`.
    #[arg(long, value_parser = choice::<BeatScaling>(), default_value = BeatScaling::TwoSegment.name(),
        requires = "heart_rate")]
    pub gating: BeatScaling,
    /// A blade on one side hides about this share (0 to 0.9) of the moving vessels of each view.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, allow_hyphen_values = true)]
    pub collimate: f64,
}

impl DegradationArgs {
    /// The degradations asked for.
    pub fn degradations(&self, catheter: bool) -> Degradations {
        let background = self.breathing_background;
        let open = self.photons.map(Photons::Unattenuated);
        Degradations {
            geometry_error: self.geometry_error,
            breathing: self.breathing.map(|breathing| Breathing { background, ..breathing }),
            photons: open.or(self.detector_photons.map(Photons::Detector)),
            contrast_variation: self.contrast_variation / 100.0,
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

/// Views of synthetic data.
#[derive(Debug, Args)]
pub struct ViewAngleArgs {
    /// Training views: the paper's 3, 4 or 9.
    #[arg(long, default_value_t = 4, conflicts_with = "angles")]
    pub views: u32,
    /// Training views by primary and secondary angle, degrees (LAO and cranial positive), instead of the paper's.
    #[arg(long, value_name = "P,S[;P,S...]", allow_hyphen_values = true, value_parser = view_angles)]
    pub angles: Option<AngleList>,
    /// Validation views, or `none`, instead of the paper's (of which those within 15 degrees of --angles are left out).
    #[arg(long, value_name = "P,S[;P,S...]", allow_hyphen_values = true, value_parser = test_angles)]
    pub test_angles: Option<AngleList>,
}

/// Angles of several views.
#[derive(Debug, Clone)]
pub struct AngleList(pub Vec<Angles>);

impl ViewAngleArgs {
    /// The views asked for.
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

/// C-arms of synthetic data: one value for all views, or one for each, those of training first.
#[derive(Debug, Args)]
pub struct CArmArgs {
    /// Source to isocentre, mm: one for all views, or one for each (training first, then validation).
    #[arg(long, default_value = "750", value_name = "MM[,MM...]", value_delimiter = ',')]
    pub sod: Vec<f64>,
    /// Source to detector, mm: one for all views, or one for each.
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
    /// Whether nothing was asked for.
    pub fn is_default(&self) -> bool {
        let at_rest = self.offset == [[0.0; 2]] && self.pixel.is_none();
        self.sod == [750.0] && self.sid == [1100.0] && self.fov == 160.0 && at_rest
    }

    /// The C-arms asked for.
    pub fn options(&self) -> CArmOptions {
        CArmOptions {
            sod_mm: self.sod.clone(),
            sid_mm: self.sid.clone(),
            pixel: self.pixel.map_or(PixelPitch::FieldOfView(self.fov), PixelPitch::Detector),
            offset_mm: self.offset.clone(),
        }
    }
}

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
    /// A phase from 0 for each selected frame, one per line, the same for all runs.
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

/// Parses one of the names of a choice.
fn choice<T: Choice>() -> impl TypedValueParser<Value = T> {
    PossibleValuesParser::new(T::ALL.iter().map(|choice| choice.name()))
        .try_map(|name| T::named(&name).ok_or("is none of the choices"))
}

/// Parses `FIRST-LAST`.
fn frame_range(text: &str) -> std::result::Result<std::ops::RangeInclusive<usize>, String> {
    let (first, last) = text.split_once('-').unwrap_or((text, text));
    match (first.trim().parse(), last.trim().parse()) {
        (Ok(first), Ok(last)) if first <= last => Ok(first..=last),
        _ => Err("write it as FIRST-LAST, as in 5-12".into()),
    }
}

/// Parses `A,B`.
fn pair(text: &str) -> Option<[f64; 2]> {
    let (a, b) = text.split_once(',')?;
    Some([a.trim().parse().ok()?, b.trim().parse().ok()?])
}

/// Parses `DEG,MM`.
fn geometry_error(text: &str) -> std::result::Result<GeometryError, String> {
    let [angle_deg, position_mm] = pair(text).ok_or("degrees and mm are needed, as DEG,MM")?;
    Ok(GeometryError { angle_deg, position_mm })
}

/// Parses `MM` or `MM,PERIOD_S`.
fn breathing(text: &str) -> std::result::Result<Breathing, String> {
    let both = pair(text).or_else(|| Some([text.trim().parse().ok()?, USUAL_BREATH_S]));
    let [peak_to_peak_mm, period_s] = both.ok_or("mm are needed, or mm and seconds as MM,PERIOD_S")?;
    Ok(Breathing { peak_to_peak_mm, period_s, background: false })
}

/// Parses a detector offset, `U,V`.
fn offset(text: &str) -> std::result::Result<[f64; 2], String> {
    pair(text).ok_or_else(|| "two lengths in mm are needed, as U,V".to_owned())
}

/// Parses `P,S[;P,S...]`.
fn view_angles(text: &str) -> std::result::Result<AngleList, String> {
    let view = |view: &str| match pair(view) {
        Some([primary_deg, secondary_deg]) => Ok(Angles { primary_deg, secondary_deg }),
        None => Err(format!("`{view}`: write primary and secondary angle as P,S and views as P,S;P,S")),
    };
    text.split(';').map(view).collect::<std::result::Result<_, _>>().map(AngleList)
}

/// Parses the same, or `none`.
fn test_angles(text: &str) -> std::result::Result<AngleList, String> {
    if text == "none" { Ok(AngleList(Vec::new())) } else { view_angles(text) }
}

/// Parses one length for both directions, or two.
fn pitch(text: &str) -> std::result::Result<[f64; 2], String> {
    let parts: Vec<f64> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    match parts[..] {
        [x] if x > 0.0 => Ok([x, x]),
        [x, y] if x > 0.0 && y > 0.0 => Ok([x, y]),
        _ => Err("one or two positive lengths in mm are needed".into()),
    }
}

/// Hyper-parameters, for every command that trains.
#[derive(Debug, Args)]
pub struct ConfigArgs {
    /// Set of defaults: `fast` (normalised, hull-gated, tuned), `paper` (as the paper states it) or `public-code` (as the
    /// authors' code does it); `fast`, unless a configuration file names one.
    #[arg(long, value_parser = choice::<Preset>())]
    pub preset: Option<Preset>,
    /// TOML file with hyper-parameters.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Set one hyper-parameter, e.g. --set dynamic.width=128. Repeatable; wins over the file.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
}

impl ConfigArgs {
    /// Builds the configuration; `more` settings come after those given with --set.
    pub fn load(&self, more: impl IntoIterator<Item = String>) -> Result<Config> {
        let settings: Vec<String> = self.set.iter().cloned().chain(more).collect();
        Config::load(self.preset, self.config.as_deref(), &settings)
    }
}

/// `train`.
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Dataset directory (native or authors' layout).
    #[arg(required_unless_present = "print_config")]
    pub data: Option<PathBuf>,
    /// Run directory.
    #[arg(short, long, value_name = "RUN", required_unless_present = "print_config")]
    pub out: Option<PathBuf>,
    /// Hyper-parameters.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Length of the run (same as --set train.iterations=N).
    #[arg(long, value_name = "N")]
    pub iterations: Option<u32>,
    /// Seed (same as --set seed=S).
    #[arg(long, value_name = "S")]
    pub seed: Option<u32>,
    /// Continue from the newest checkpoint in RUN, with its configuration.
    #[arg(long, conflicts_with_all = ["preset", "config", "set", "iterations", "seed"])]
    pub resume: bool,
    /// Save and stop after N iterations; schedules keep the full length.
    #[arg(long, value_name = "N")]
    pub stop_at: Option<u32>,
    /// One JSON object per line on stdout instead of a progress bar.
    #[arg(long)]
    pub json: bool,
    /// Leave scores and pictures of the unseen images for `eval`.
    #[arg(long)]
    pub no_eval: bool,
    /// Start over in a directory that already holds a run.
    #[arg(short, long)]
    pub force: bool,
    /// Print the configuration as TOML and exit.
    #[arg(long)]
    pub print_config: bool,
    /// Export the motion hull as NRRD and exit without training.
    #[arg(long, value_name = "FILE.nrrd")]
    pub export_hull: Option<PathBuf>,
}

/// `eval`.
#[derive(Debug, Args)]
pub struct EvalArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Dataset with validation frames; the one the run was trained on by default.
    #[arg(long, value_name = "DATA")]
    pub data: Option<PathBuf>,
    /// JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Leave comparison pictures and `report.html` here; without, a page without pictures is left in RUN as `eval.html`.
    #[arg(long, value_name = "DIR")]
    pub images: Option<PathBuf>,
    /// Dice threshold on attenuation, 1/mm, instead of the rule.
    #[arg(long, value_name = "PER_MM")]
    pub threshold: Option<f64>,
}

/// `render`.
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Primary angle, degrees, LAO positive.
    #[arg(long, allow_negative_numbers = true, value_name = "DEG", default_value_t = 0.0)]
    pub primary: f64,
    /// Secondary angle, degrees, cranial positive.
    #[arg(long, allow_negative_numbers = true, value_name = "DEG", default_value_t = 0.0)]
    pub secondary: f64,
    /// Phase from 0, or `all`; between two, as 3.4, where one set of Gaussians moves (preset fast, gaussians.form = "tree").
    #[arg(long, default_value = "0", allow_negative_numbers = true)]
    pub phase: String,
    /// Pictures between neighbouring phases, for smooth animations with --phase all.
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = clap::value_parser!(u32).range(0..=32))]
    pub between: u32,
    /// Field to show: both, the still background or the moving vessels.
    #[arg(long, value_parser = choice::<Component>(), default_value = Component::Total.name())]
    pub component: Component,
    /// Line integral (`drr`) or largest attenuation along the ray (`mip`).
    #[arg(long, value_parser = choice::<Projection>(), default_value = Projection::Drr.name())]
    pub projection: Projection,
    /// Columns and rows; those of the dataset by default.
    #[arg(long)]
    pub size: Option<usize>,
    /// Through volumes baked from the fields: faster, and as fine as their cells.
    #[arg(long)]
    pub baked: bool,
    /// Measure frames per second, read back to the host, of the chosen component turning about the patient: both ways, at
    /// 200 x 200, 512 x 512, and --size.
    #[arg(long)]
    pub fps: bool,
    /// Output: .png, .npy (floats; all phases stacked) or .gif (all phases).
    #[arg(short, long, value_name = "FILE", required_unless_present = "fps")]
    pub out: Option<PathBuf>,
}

/// `view`.
#[derive(Debug, Args)]
pub struct ViewArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Port on 127.0.0.1; a free one by default.
    #[arg(long, default_value_t = 0)]
    pub port: u16,
}

/// `export`.
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Field to export: both, the still background or the moving vessels.
    #[arg(long, value_parser = choice::<Component>(), default_value = Component::Dynamic.name())]
    pub component: Component,
    /// Phase from 0, or `all`: a fourth axis, or a file per phase.
    #[arg(long, default_value = "all")]
    pub phase: String,
    /// Distance between points, mm.
    #[arg(long, default_value_t = 0.5, value_name = "MM")]
    pub spacing: f64,
    /// Format; by the end of --out otherwise.
    #[arg(long, value_parser = choice::<Format>())]
    pub format: Option<Format>,
    /// Compress the values of an .nrrd (a .nii.gz is compressed by its name).
    #[arg(long, conflicts_with = "mesh")]
    pub compress: bool,
    /// Surfaces of the vessels instead of volumes: --out ends in .stl, .ply, .obj (a file per phase) or .glb (animated).
    #[arg(long, conflicts_with = "format")]
    pub mesh: bool,
    /// Attenuation of the surface, 1/mm; the Dice threshold otherwise.
    #[arg(long, requires = "mesh", value_name = "PER_MM")]
    pub iso: Option<f64>,
    /// Motion instead of volumes: displacements from phase 0 at the nodes of the grid that moves the Gaussians, mm, where
    /// one set moves (gaussians.form = "tree"); --out ends in .nrrd or .vtk. Motion along a vessel is not observed in
    /// projections: displacements along vessels come from smoothness alone, and no strain can be read from them.
    #[arg(long, conflicts_with_all = ["mesh", "format", "component", "spacing"])]
    pub motion: bool,
    /// With --motion: the way of each Gaussian over the beat, its own motion included, as lines in a .vtk.
    #[arg(long, requires = "motion", conflicts_with_all = ["compress", "phase"])]
    pub trajectories: bool,
    /// Output: .nrrd (.seq.nrrd for 3D Slicer's sequences), .nii, .nii.gz, .mha, .npy or .vtk.
    #[arg(short, long, value_name = "FILE")]
    pub out: PathBuf,
}

/// `tree`.
#[derive(Debug, Args)]
pub struct TreeArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Phase from 0, or `all`. Where one set of Gaussians moves (gaussians.form = "tree"), point i of branch b is the same
    /// material point at every phase; elsewhere each phase has a tree of its own, and program and file say "not tracked".
    #[arg(long, default_value = "all")]
    pub phase: String,
    /// Attenuation from which the moving field is vessel, 1/mm; the Dice threshold otherwise.
    #[arg(long, value_name = "PER_MM")]
    pub threshold: Option<f64>,
    /// Branches that end without reaching so far beyond the vessel they leave are spurs and left out, mm; three times what
    /// the field resolves otherwise.
    #[arg(long, value_name = "MM")]
    pub min_branch: Option<f64>,
    /// Output: .json (all phases), .vtp (a file per phase and a .pvd of them all, for ParaView, 3D Slicer and VMTK) or .swc
    /// (a file per phase). Millimetres along (left, posterior, superior).
    #[arg(short, long, value_name = "FILE")]
    pub out: PathBuf,
}

/// `calibrate`.
#[derive(Debug, Args)]
pub struct CalibrateArgs {
    /// Dataset directory in either layout.
    pub data: PathBuf,
    /// What is corrected.
    #[arg(long, value_parser = choice::<CalibrateMode>(), default_value = "auto")]
    pub mode: CalibrateMode,
    /// Dataset directory to make: the same images with corrected geometry, and pictures of what changed in `calibration`.
    #[arg(short, long)]
    pub out: PathBuf,
    /// JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// `convert`.
#[derive(Debug, Args)]
pub struct ConvertArgs {
    /// Dataset directory in either layout.
    pub data: PathBuf,
    /// Layout to write: `native` (`dataset.json`), or `nerfca`, that of the NeRF-CA and NerT-CA authors.
    #[arg(long, value_parser = choice::<Layout>())]
    pub layout: Layout,
    /// Directory to make.
    #[arg(short, long)]
    pub out: PathBuf,
}

/// `bench`.
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// Dataset directory; the default phantom, made on the fly, without.
    pub data: Option<PathBuf>,
    /// Hyper-parameters.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Iterations of each timed repeat.
    #[arg(long, default_value_t = 32, value_parser = clap::value_parser!(u32).range(1..=2000))]
    pub iterations: u32,
    /// Timed repeats.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=10))]
    pub repeats: u32,
    /// Also run the whole reconstruction, with time-to-Dice.
    #[arg(long)]
    pub full: bool,
    /// List the time of each pass.
    #[arg(long)]
    pub kernels: bool,
    /// Also measure frames per second of renderings.
    #[arg(long)]
    pub render: bool,
    /// Write everything, with raw samples, configuration and commit, as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Compare with a file of an earlier --json.
    #[arg(long, value_name = "FILE")]
    pub compare: Option<PathBuf>,
}

/// `check`.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// Dataset directory.
    pub data: PathBuf,
    /// JSON instead of text.
    #[arg(long)]
    pub json: bool,
    /// Leave a picture of each training view here, with what all views agree on in orange.
    #[arg(long, value_name = "DIR")]
    pub pictures: Option<PathBuf>,
}

/// `info`.
#[derive(Debug, Args)]
pub struct InfoArgs {
    /// Dataset directory, run directory or checkpoint.
    #[arg(required_unless_present = "schema")]
    pub path: Option<PathBuf>,
    /// JSON instead of text.
    #[arg(long)]
    pub json: bool,
    /// Print the JSON schema of `dataset.json` and exit.
    #[arg(long)]
    pub schema: bool,
}

/// `completions`.
#[derive(Debug, Args)]
pub struct CompletionsArgs {
    /// Shell to print for.
    pub shell: clap_complete::Shell,
}

/// Parses `X,Y,Z`.
fn triple<T: std::str::FromStr>(text: &str) -> std::result::Result<[T; 3], String> {
    let parts: Vec<T> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    parts.try_into().map_err(|_| "three numbers are needed, as X,Y,Z".to_owned())
}

impl Cli {
    /// Opens the device the options ask for.
    pub fn open_device(&self) -> Result<Gpu> {
        Gpu::open(&DeviceOptions {
            select: self.device.clone(),
            validation: self.validate,
            cache_dir: cache_dir(),
            ..DeviceOptions::default()
        })
    }

    /// Paths through the kernels for a configuration: as the options ask, as an earlier training on this device found
    /// faster, or as the device suggests.
    pub fn tuning(&self, gpu: &Gpu, config: &Config) -> Tuning {
        let tuning = Tuning::for_device(gpu.info());
        let Some(layers) = self.layers else {
            return match cache_dir().and_then(|cache| calibrate::recall(&cache, gpu.info(), config)) {
                Some(verdict) if tuning.layers == Layers::Matrices => verdict.apply(tuning),
                _ => tuning,
            };
        };
        let reason = match layers {
            Layers::F32 => "f32 layers, as asked",
            Layers::Matrices => "matrix layers, as asked: f16 operands, f32 sums",
        };
        tuning.with_layers(layers, reason.into())
    }

    /// As [`Cli::tuning`], after timing both paths where that is still to be done.
    pub fn training_tuning(&self, gpu: &Gpu, config: &Config, dataset: &Dataset) -> Result<Tuning> {
        let tuning = Tuning::for_device(gpu.info());
        let either = self.layers.is_none() && tuning.layers == Layers::Matrices && !config.gaussians_move();
        let cache = cache_dir().filter(|_| either);
        let Some(cache) = cache.filter(|cache| calibrate::recall(cache, gpu.info(), config).is_none()) else {
            return Ok(self.tuning(gpu, config));
        };
        let verdict = calibrate::measure(gpu, config, dataset, &tuning)?;
        if let Err(error) = calibrate::remember(&cache, gpu.info(), config, verdict) {
            // It only has to be measured again.
            tracing::warn!("{error}");
        }
        Ok(verdict.apply(tuning))
    }

    /// Saves the pipeline cache and turns validation messages into a failure.
    pub fn close_device(&self, gpu: &Gpu) -> Result<()> {
        if let Err(error) = gpu.save_pipeline_cache() {
            // A missing cache only costs time at the next start.
            tracing::warn!("{error}");
        }
        match gpu.validation_messages().len() {
            0 => Ok(()),
            n => Err(nertca_vk::error::Error::Internal(format!("{n} Vulkan validation messages, printed above"))),
        }
    }
}

/// The user's cache directory (XDG), if there is one.
fn cache_dir() -> Option<PathBuf> {
    let base = std::env::var_os("XDG_CACHE_HOME")
        .map(PathBuf::from)
        .filter(|p| p.is_absolute())
        .or_else(|| std::env::var_os("HOME").map(|home| PathBuf::from(home).join(".cache")))?;
    Some(base.join("nertca-vk"))
}
