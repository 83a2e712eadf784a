//! The command `tree`.

use crate::args::options::GlobalOptions;
use crate::command::data::bar;
use crate::command::export::phases;
use crate::output::{Earlier, numbers_of_checkpoint, random_numbers};
use clap::Args;
use nertca_vk::calibrate::correction::Calibration;
use nertca_vk::checkpoint::newest_model;
use nertca_vk::error::{Error, Result};
use nertca_vk::export::presentation::PresentationSeeds;
use nertca_vk::export::structured::ReportSeeds;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::model::Model;
use nertca_vk::raster::percentile;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk::scan::references::{REFERENCES, References};
use nertca_vk_runs::run::info::RunInfo;
use nertca_vk_runs::run::score::as_trained;
use nertca_vk_runs::run::tree_score::score_tree;
use nertca_vk_vessels::score::eval::Evaluation;
use nertca_vk_vessels::trees::doubt;
use nertca_vk_vessels::trees::extract::{TreeOptions, vessel_trees};
use nertca_vk_vessels::trees::files::measurements;
use nertca_vk_vessels::trees::files::over_frames;
use nertca_vk_vessels::trees::files::{TreeFormat, note, write};
use nertca_vk_vessels::trees::lesions::{Lesion, MeasuredBeat, lesions};
use nertca_vk_vessels::trees::tree::{BeatTree, CONFIDENCE, DOUBTFUL};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Arguments of `tree`.
#[derive(Debug, Args)]
pub struct TreeArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Phase from 0, or `all`. With one deformable set of Gaussians (gaussians.form = "deformable"), point i of branch b is
    /// the same material point at every phase; otherwise each phase has its own tree, and program and file say "not
    /// tracked".
    #[arg(long, default_value = "all")]
    pub phase: String,
    /// Attenuation threshold above which the dynamic field is vessel, 1/mm; by default the Dice threshold.
    #[arg(long, value_name = "PER_MM")]
    pub threshold: Option<f64>,
    /// Minimum length by which a branch must extend beyond the vessel it leaves, mm; shorter end branches are spurs and
    /// omitted. By default three times the field's resolution.
    #[arg(long, value_name = "MM")]
    pub min_branch: Option<f64>,
    /// Write the centrelines over the frames of the source runs as a DICOM presentation state, which names the patient: --out ends in
    /// .dcm. The dataset must have been made by `import dicom --keep-references`.
    #[arg(long)]
    pub presentation: bool,
    /// Replace the files of an earlier series (`NAME_0000.EXT` and so on), all of them.
    #[arg(short, long)]
    pub force: bool,
    /// Output: .json (all phases), .vtp (one file per phase, and a .pvd that lists them, for ParaView, 3D Slicer and
    /// VMTK), .swc (one file per phase), in millimetres along (left, posterior, superior); .glb (tubes, animated
    /// over the beat; metres); or .dcm (lengths, diameters and stenoses of all phases as a DICOM structured report).
    #[arg(short, long, value_name = "FILE")]
    pub out: PathBuf,
}

/// File in the run directory with the tree that the run's page shows.
const TREE_FILE: &str = "tree.json";

/// Finds the tree of all phases of a model for a run's page, with the training views of the dataset, and writes it to a file beside the page. If the model has no
/// vessels or the file cannot be written, a warning is added.
pub fn of_page(
    global: &GlobalOptions,
    (gpu, model): (&Gpu, &Model),
    (run, dataset): (&Path, &Dataset),
    cancel: &AtomicBool,
    directory: &Path,
    warnings: &mut Vec<String>,
) -> Result<Option<BeatTree>> {
    let phases = (0..model.shown_phases()).collect();
    let options = TreeOptions { phases, threshold_per_mm: None, least_branch_mm: None };
    match find(global, gpu, model, cancel, &options) {
        Ok(mut beat) => {
            compare_with_views(&mut beat, dataset, run)?;
            leave(&beat, directory, warnings)?;
            Ok(Some(beat))
        }
        Err(error @ Error::Config { .. }) => {
            warnings.push(format!("The vessel tree could not be extracted: {error}."));
            remove_old(directory, warnings);
            Ok(None)
        }
        Err(error) => Err(error),
    }
}

/// Writes a tree beside its page.
fn leave(beat: &BeatTree, directory: &Path, warnings: &mut Vec<String>) -> Result<()> {
    match write(beat, &directory.join(TREE_FILE), TreeFormat::Json, true) {
        Err(error @ Error::Io { .. }) => {
            warnings.push(format!("The file of the vessel tree could not be written: {error}."));
            remove_old(directory, warnings);
            Ok(())
        }
        written => written.map(drop),
    }
}

/// Removes the tree that an earlier page left in a directory, so that it is not mistaken for that of a new page without one. If
/// the file cannot be removed, a warning is added.
pub fn remove_old(directory: &Path, warnings: &mut Vec<String>) {
    let file = directory.join(TREE_FILE);
    match std::fs::remove_file(&file) {
        Err(error) if error.kind() != ErrorKind::NotFound => {
            warnings
                .push(format!("{} does not belong to this page and could not be removed: {error}.", file.display()));
        }
        _ => {}
    }
}

/// Scores the tree of a page, where there is a truth. If the truth cannot be used, a warning is added.
pub fn score(tree: Option<&BeatTree>, dataset: &Dataset, evaluation: &mut Evaluation) -> Result<()> {
    let Some(tree) = tree else { return Ok(()) };
    match score_tree(tree, dataset) {
        Err(error @ (Error::Data { .. } | Error::Io { .. })) => {
            evaluation.warnings.push(format!("The vessel tree could not be scored: {error}."));
        }
        scores => evaluation.tree = scores?,
    }
    Ok(())
}

fn find(
    global: &GlobalOptions,
    gpu: &Gpu,
    model: &Model,
    cancel: &AtomicBool,
    options: &TreeOptions,
) -> Result<BeatTree> {
    let renderer = Renderer::new(gpu, model, global.tuning(gpu, &model.config))?;
    let mut progress = bar();
    vessel_trees(&renderer, model, options, |n, of| {
        progress("trees", n, of);
        if cancel.load(Ordering::Relaxed) { Err(Error::Interrupted) } else { Ok(()) }
    })
}

/// Describes a lesion, and its percentages over the beat where they are known, in a line.
fn in_words(lesion: &Lesion, over_beat: &[f64]) -> String {
    let (least, most) =
        over_beat.iter().fold((f64::MAX, f64::MIN), |(a, b), percent| (a.min(*percent), b.max(*percent)));
    let range = match over_beat {
        [] | [_] => String::new(),
        _ => format!("; {least:.0} to {most:.0} % in the fields of the phases"),
    };
    format!(
        "stenosis of {:.0} % in branch {}, {:.1} mm from the root: {:.2} mm instead of {:.2} mm, over {:.1} mm{range}",
        lesion.percent(),
        lesion.branch,
        lesion.from_root_mm,
        lesion.min_diameter_mm,
        lesion.reference_diameter_mm,
        lesion.length_mm
    )
}

/// Returns the phases in which vessels must be found for the trees of some phases: all, where points are followed, because their radii are
/// measured in the images of all phases together.
fn phases_to_find(model: &Model, phases: &[u32]) -> Vec<u32> {
    let follows = model.gaussians.as_ref().is_some_and(|gaussians| gaussians.moving().is_some());
    if follows { (0..model.shown_phases()).collect() } else { phases.to_vec() }
}

/// Finds the vessels of a model at phases, or at all of them where points are followed.
pub fn found_in_phases(global: &GlobalOptions, gpu: &Gpu, model: &Model, phases: Vec<u32>) -> Result<BeatTree> {
    let phases = phases_to_find(model, &phases);
    let options = TreeOptions { phases, threshold_per_mm: None, least_branch_mm: None };
    // Ctrl-C may end the program at once, because nothing has been written.
    find(global, gpu, model, &AtomicBool::new(false), &options)
}

/// States in a tree what depends on the training views of its run: the views themselves, the radii and the doubt about each point.
fn compare_with_views(beat: &mut BeatTree, dataset: &Dataset, run: &Path) -> Result<()> {
    let calibration = Calibration::read(run)?;
    let disagreement_px = calibration.map_or(0.0, |calibration| calibration.disagreement_px);
    report(doubt::compare_with_views(beat, dataset, Some(disagreement_px)));
    Ok(())
}

/// Says why the radii of a tree are those of the field, where they are.
fn report(reason: Option<&str>) {
    if let Some(reason) = reason {
        eprintln!("the radii of vessels are those of the field: {reason}");
    }
}

/// Returns the dataset of a run as it was calibrated.
fn dataset_of(run: &Path) -> Result<Dataset> {
    let directory = if run.is_dir() { run } else { run.parent().unwrap_or(Path::new("")) };
    as_trained(Dataset::open(&RunInfo::read(run)?.dataset)?, directory)
}

/// States in a tree what depends on the training views of a run; says why where they are not known.
pub fn compare_with_run(beat: &mut BeatTree, run: &Path) {
    if let Err(error) = dataset_of(run).and_then(|dataset| compare_with_views(beat, &dataset, run)) {
        eprintln!(
            "doubt and the sight of stenoses in the training views are not stated, and the radii of vessels are those of the field: \
             {error}"
        );
    }
}

/// States the training views of a run in a tree, and measures its radii in their images; where they are not known, `lacking` says what that
/// means.
pub fn measure_in_run(beat: &mut BeatTree, run: &Path, lacking: &str) {
    match dataset_of(run) {
        Ok(dataset) => report(doubt::compare_with_views(beat, &dataset, None)),
        Err(error) => eprintln!("{lacking}: {error}"),
    }
}

/// Kind of file to which a tree is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Output {
    Tree(TreeFormat),
    /// DICOM structured report.
    Measurements,
    /// DICOM presentation state.
    Presentation,
}

impl Output {
    /// Returns the kind by the extension of --out, and by --presentation.
    fn of(args: &TreeArgs) -> Result<Output> {
        let is_dicom = args.out.extension().is_some_and(|end| end.eq_ignore_ascii_case("dcm"));
        let unknown = |known| Error::config("--out", args.out.display(), format!("does not end in {known}"));
        match (is_dicom, args.presentation) {
            (true, true) => Ok(Output::Presentation),
            (true, false) => Ok(Output::Measurements),
            (false, true) => Err(unknown(".dcm, as a presentation state must")),
            (false, false) => {
                TreeFormat::of(&args.out).map(Output::Tree).ok_or_else(|| unknown("one of .json .vtp .swc .glb .dcm"))
            }
        }
    }
}

/// Writes the measurements of a tree and returns the file.
fn write_measurements(beat: &BeatTree, args: &TreeArgs) -> Result<Vec<PathBuf>> {
    let [study, frame] = numbers_of_checkpoint(&args.run)?;
    let [series, instance, tracking] = random_numbers()?;
    measurements::write(beat, &args.out, &ReportSeeds { study, series, frame, instance, tracking })?;
    Ok(vec![args.out.clone()])
}

/// References of a dataset to the runs from which it was imported.
struct Sources {
    dataset: Dataset,
    references: References,
}

impl Sources {
    /// Reads the references of the dataset of a run.
    fn of(run: &Path) -> Result<Sources> {
        let dataset = dataset_of(run)?;
        let references = References::read(&dataset.path)?.ok_or_else(|| {
            let problem = "is missing: a presentation state needs references to the frames of the runs; import them again with \
                           --keep-references";
            Error::data(dataset.path.join(REFERENCES), "file", problem)
        })?;
        Ok(Sources { dataset, references })
    }

    /// Writes the centrelines of a tree over the frames of the runs and returns the file.
    fn write_presentation(&self, beat: &BeatTree, out: &Path) -> Result<Vec<PathBuf>> {
        let [series, instance] = random_numbers()?;
        over_frames::write(beat, &self.dataset, &self.references, out, &PresentationSeeds { series, instance })?;
        Ok(vec![out.to_owned()])
    }
}

/// Finds the vessels of a run as trees and writes them.
pub fn run(global: &GlobalOptions, args: &TreeArgs) -> Result<()> {
    let format = Output::of(args)?;
    let sources = if format == Output::Presentation { Some(Sources::of(&args.run)?) } else { None };
    let model = newest_model(&args.run)?;
    let (phases, all) = phases(&args.phase, &model)?;
    let several = all && matches!(format, Output::Tree(TreeFormat::Vtp | TreeFormat::Swc));
    let earlier = if several { Earlier::series(&args.out, args.force)? } else { Earlier::none() };
    let gpu = global.open_device()?;
    let sought = phases_to_find(&model, &phases);
    let options = TreeOptions { phases: sought, threshold_per_mm: args.threshold, least_branch_mm: args.min_branch };
    // Ctrl-C may end the program at once, because no partial result has been written here.
    let mut beat = find(global, &gpu, &model, &AtomicBool::new(false), &options)?;
    compare_with_run(&mut beat, &args.run);
    beat.keep_phases(&phases);
    let made = match (&sources, format) {
        (Some(sources), _) => sources.write_presentation(&beat, &args.out)?,
        (None, Output::Tree(format)) => write(&beat, &args.out, format, all)?,
        (None, _) => write_measurements(&beat, args)?,
    };
    earlier.make_way(&made)?;
    made.iter().for_each(|path| out!("{}", path.display()));
    for tree in &beat.phases {
        let widths_mm: Vec<f32> =
            tree.branches.iter().flat_map(|branch| &branch.doubt).map(|doubt| doubt.across_mm as f32).collect();
        let width = match widths_mm.is_empty() {
            true => String::new(),
            false => format!(", known to {:.2} mm (median, {:.0} %)", percentile(&widths_mm, 0.5), 100.0 * CONFIDENCE),
        };
        let share = format!("{:.0} % of the other fits", 100.0 * DOUBTFUL);
        let doubt = match tree.doubtful_mm() {
            None => String::new(),
            Some(0.0) => format!("; at least {share} have all of it"),
            Some(mm) => format!("; less than {share} have {mm:.1} mm of it, which may be false"),
        };
        eprintln!(
            "phase {}: {:.1} mm in {} branches, components: {}{width}{doubt}",
            tree.phase,
            tree.length_mm(),
            tree.branches.len(),
            tree.components()
        );
    }
    if beat.views.len() < doubt::LEAST_VIEWS && !beat.views.is_empty() {
        eprintln!(
            "how far points are known is not stated: two views are explained as well by vessels that exchange their depths where they cross; \
             a third view decides (`next` names one)"
        );
    }
    // Followed points keep their radii, so that lesions differ between phases only as far as lengths change.
    let measured = MeasuredBeat::new(&beat);
    let with_lesions = if beat.reference_phase.is_some() { 1 } else { beat.phases.len() };
    for tree in beat.phases.iter().take(with_lesions) {
        for (index, branch) in tree.branches.iter().enumerate().filter(|(_, branch)| branch.gap_mm > 0.0) {
            eprintln!(
                "phase {}: branch {index} has a gap of {:.1} mm: the field is below the threshold there, and two vessels are linked because one \
                 points at the other",
                tree.phase, branch.gap_mm
            );
        }
        for lesion in lesions(tree, beat.measurement()) {
            eprintln!("phase {}: {}", tree.phase, in_words(&lesion, &measured.percents(&lesion)));
        }
    }
    eprintln!(
        "a point is vessel above {:.4e} per mm; the resolution of the field is {:.2} mm, and it was sampled every \
         {:.2} mm; {}",
        beat.threshold_per_mm,
        beat.resolution_mm,
        beat.spacing_mm,
        note(&beat)
    );
    global.close_device(&gpu)
}
