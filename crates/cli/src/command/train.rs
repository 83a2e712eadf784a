//! `train`: performs a run and writes its report.

use crate::args::options::{ConfigArgs, GlobalOptions};
use crate::command::eval::print_table;
use crate::command::tree::{of_page as tree_of_page, remove_old as remove_old_tree, score as score_tree_of_page};
use crate::memory::{return_freed, room_for_training};
use crate::pages::report::Report;
use crate::progress::{print_json, show_progress, stop_flag};
use clap::Args;
use clap::error::ErrorKind;
use nertca_vk::checkpoint::{self, newest_model};
use nertca_vk::config::Config;
use nertca_vk::error::{Error, Result};
use nertca_vk::files::{self, Lock};
use nertca_vk::formats::nrrd;
use nertca_vk::gpu::calls::Calls;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::{Dataset, MANIFEST};
use nertca_vk::scan::prior::{PRIOR, VesselPrior};
use nertca_vk_runs::run::events::{Event, Stage, StageClock, StageTime};
use nertca_vk_runs::run::info::RunInfo;
use nertca_vk_runs::run::prior;
use nertca_vk_runs::run::reconstruct::{CONFIG, RunOptions, reconstruct};
use nertca_vk_runs::run::score::{ScoreOptions, as_trained, evaluate_model};
use nertca_vk_vessels::score::eval::{Evaluation, moving_field_warning};
use std::cell::RefCell;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Arguments of `train`.
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Dataset directory (native or authors' layout); with --resume and --out, by default the one that the run was begun on.
    pub data: Option<PathBuf>,
    /// Run directory; by default the name of DATA with `-run`, in the current directory.
    #[arg(short, long, value_name = "RUN")]
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
    /// Vessels that are known before, e.g. from a CT: a tree (.json, .vtp, .pvd) or a volume with the vessels as its brightest voxels
    /// (.nrrd, .nii, .mha), in patient coordinates with the isocentre at the origin. It decides where vessels are sought first; the
    /// views decide whether they are there. For `fast`.
    #[arg(long, value_name = "FILE", conflicts_with = "resume")]
    pub prior: Option<PathBuf>,
    /// Continue from the newest checkpoint in RUN, with its configuration.
    #[arg(long, conflicts_with_all = ["preset", "config", "set", "iterations", "seed"])]
    pub resume: bool,
    /// Save and stop after N iterations; schedules are computed for the full length.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub stop_at: Option<u32>,
    /// Print one JSON object per line on stdout instead of a progress bar.
    #[arg(long)]
    pub json: bool,
    /// Do not write scores and pictures of the unseen images; `eval` can do it later.
    #[arg(long)]
    pub no_eval: bool,
    /// Also find the vessels as a tree (takes seconds): shown over the angiograms in the report, with lengths and
    /// diameters, and written as `tree.json` beside it.
    #[arg(long)]
    pub tree: bool,
    /// Print the time of each stage, and the numbers of calls to the device; `run.json` has them as well.
    #[arg(long)]
    pub timings: bool,
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

/// Message for a command line without a dataset.
const NO_DATA: &str = "the directory of a dataset is missing: nertca-vk train DATA. Make a synthetic one with `nertca-vk phantom \
                       heart`, or one of angiograms with `nertca-vk import dicom FILE... -o DATA`\n";

/// Returns the directory of a run whose user named none: the name of its dataset with `-run`, in the current directory.
fn default_run(data: &Path) -> Result<PathBuf> {
    let named = data.canonicalize().map_err(Error::io("read", data))?;
    let mut name = named.file_name().unwrap_or("dataset".as_ref()).to_owned();
    name.push("-run");
    Ok(PathBuf::from(name))
}

fn config(args: &TrainArgs) -> Result<Config> {
    let iterations = args.iterations.map(|n| format!("train.iterations={n}"));
    args.config.load(iterations.into_iter().chain(args.seed.map(|s| format!("seed={s}"))))
}

/// Trains and writes the report.
pub fn run(global: &GlobalOptions, args: &TrainArgs) -> Result<()> {
    let config = config(args)?;
    if args.print_config {
        out!("{}", config.acting_toml()?.trim_end());
        return Ok(());
    }
    let data = &match (&args.data, &args.out) {
        (Some(data), _) => data.clone(),
        (None, Some(run)) if args.resume => RunInfo::read(run)?.dataset,
        _ => clap::Error::raw(ErrorKind::MissingRequiredArgument, NO_DATA).exit(),
    };
    let mut clock = StageClock::start();
    let mut dataset = Dataset::open(data)?;
    let prior = prior(args.prior.as_deref(), &config)?;
    let run = &args.out.clone().map_or_else(|| default_run(data), Ok)?;
    if let Some(file) = &args.export_hull {
        return export_hull(&config, &dataset, file);
    }
    if run.join(MANIFEST).exists() || run.canonicalize().ok() == data.canonicalize().ok() {
        let problem = "is the directory of a dataset; a run has a directory of its own";
        return Err(Error::config("--out", run.display(), problem));
    }
    // A run that is to be resumed must exist.
    let _lock = if args.resume && !run.exists() { None } else { Some(take_run(run)?) };
    prepare_directory(run, args)?;
    room_for_training()?;
    dataset.prior = kept_prior(prior, run, args)?;
    let cancel = stop_flag()?;
    let mut stages = vec![clock.end(Stage::Read)];
    let gpu = global.open_device()?;
    stages.push(clock.end(Stage::Device));
    let mut info = RunInfo::new(&dataset.path);
    if !args.resume {
        info.write(run)?;
    }
    let written = RefCell::new(Ok(()));
    let (config, resume) = if args.resume { resumed(run)? } else { (config, false) };
    let tuning = global.training_tuning(&gpu, &config, &dataset)?;
    let options = RunOptions { tuning: &tuning, run, resume, stop_at: args.stop_at, cancel: &cancel };
    let mut show: Box<dyn FnMut(&Event)> = if args.json { Box::new(print_json) } else { Box::new(show_progress()) };
    let mut observer = |event: &Event| {
        if let Event::Finished { stages: of_run, .. } = event {
            stages.extend(of_run);
        }
        if let Event::Started { .. } = event {
            // A run that is resumed keeps its record until the dataset was found to be that of its checkpoint.
            if args.resume {
                *written.borrow_mut() = info.write(run);
            }
            return_freed();
        }
        show(event);
    };
    reconstruct(&gpu, &config, &dataset, &options, &mut observer)?;
    written.replace(Ok(()))?;
    let mut clock = StageClock::start();
    let dataset = as_trained(dataset, run)?;
    let report = run.join("report");
    let (model, page) = (newest_model(run)?, run.join("report.html"));
    let mut warnings = Vec::new();
    let mut evaluation = None;
    if !args.no_eval && dataset.validation().is_empty() {
        warnings.extend(moving_field_warning(&Renderer::new(&gpu, &model, tuning.clone())?, &dataset)?);
    } else if !args.no_eval {
        let scoring = ScoreOptions { threshold_per_mm: None, pictures: Some(&report), cancel: &cancel };
        let outcome = evaluate_model(&gpu, &tuning, &model, &dataset, &scoring, &mut observer);
        if let Err(Error::Interrupted) = outcome {
            let (run, report) = (run.display(), report.display());
            eprintln!("the run is complete, but not scored; use: nertca-vk eval \"{run}\" --images \"{report}\"");
        }
        let scores = outcome?;
        // The scores are written now, and again with those of the tree, because finding the tree may fail or be
        // stopped.
        write_scores(&report, &scores)?;
        evaluation = Some(scores);
    }
    stages.push(clock.end(Stage::Score));
    drop(show);
    let tree = if args.tree {
        tree_of_page(global, (&gpu, &model), (run, &dataset), &cancel, run, &mut warnings)?
    } else {
        remove_old_tree(run, &mut warnings);
        None
    };
    if let Some(scores) = &mut evaluation {
        scores.warnings.append(&mut warnings);
        score_tree_of_page(tree.as_ref(), &dataset, scores)?;
        write_scores(&report, scores)?;
        warnings.clone_from(&scores.warnings);
    }
    stages.push(clock.end(Stage::Tree));
    Report {
        gpu: &gpu,
        tuning: &tuning,
        model: &model,
        dataset: &dataset,
        evaluation: evaluation.as_ref(),
        warnings: &warnings,
        tree: tree.as_ref(),
        run,
        pictures: &report,
    }
    .write(&page)?;
    stages.push(clock.end(Stage::Report));
    (info.stages, info.calls) = (stages, Some(gpu.calls()));
    info.write(run)?;
    if args.timings {
        print_timings(&info);
    }
    if !args.json {
        if let Some(evaluation) = &evaluation {
            print_table(evaluation);
        }
        out!("report: {}", page.display());
        out!("next: nertca-vk view \"{}\"   (turn the C-arm in a browser while the beat plays)", run.display());
    }
    warnings.iter().for_each(|warning| eprintln!("warning: {warning}"));
    global.close_device(&gpu)
}

/// Prints the stages of a run and its calls to the device to stderr, beside the progress.
fn print_timings(info: &RunInfo) {
    for StageTime { stage, seconds } in &info.stages {
        eprintln!("{:<10} {seconds:9.3} s", stage.name());
    }
    if let Some(Calls { submits, waits, recordings, buffers, barriers }) = info.calls {
        eprintln!(
            "calls to the device: {submits} submits, {waits} waits, {recordings} recordings, {buffers} buffers made, {barriers} barriers"
        );
    }
}

fn write_scores(report: &Path, scores: &Evaluation) -> Result<()> {
    Ok(files::write_atomic(&report.join("evaluation.json"), files::pretty_json(scores)?.as_bytes())?)
}

/// Name of the file that the process holds which trains into a run directory.
pub(crate) const LOCK: &str = "train.lock";

/// Takes a run directory for this process, so that two trainings, or a training and a watch, do not mix their files in it.
pub(crate) fn take_run(run: &Path) -> Result<Lock> {
    let lock = Lock::take(&run.join(LOCK))?.ok_or_else(|| {
        let problem = "another process trains into this run directory: wait for it, or choose another --out";
        let record = run.join(format!("{LOCK}.process"));
        let stale = match record.exists() {
            true => format!("; where no such process runs on any computer, remove {}", record.display()),
            false => String::new(),
        };
        Error::Busy(format!("{}: {problem}{stale}", run.display()))
    })?;
    if let Some(record) = lock.record() {
        eprintln!(
            "warning: {}: the file system has no locks; {} keeps other processes out instead, and must be removed by hand where this \
             computer fails during the run",
            run.display(),
            record.display()
        );
    }
    Ok(lock)
}

/// Returns the configuration of a run that is to be resumed, for which the paths are chosen, and whether there is a checkpoint to
/// continue from: a run that was killed before its first one starts over.
fn resumed(run: &Path) -> Result<(Config, bool)> {
    let config = run.join(CONFIG);
    if !config.is_file() || !checkpoint::list(run)?.is_empty() {
        return Ok((newest_model(run)?.config, true));
    }
    eprintln!("{}: there is no checkpoint yet, so the run starts over, with its own configuration", run.display());
    Ok((Config::load(None, Some(&config), &[])?, false))
}

/// Reads the prior vessels that the command line names.
pub fn prior(file: Option<&Path>, config: &Config) -> Result<Option<VesselPrior>> {
    let Some(file) = file else { return Ok(None) };
    config.takes_prior("--prior", &file.display().to_string())?;
    prior::read(file).map(Some)
}

/// Keeps prior vessels in the run directory, where `--resume` finds them, and returns those of the run.
fn kept_prior(prior: Option<VesselPrior>, run: &Path, args: &TrainArgs) -> Result<Option<Arc<VesselPrior>>> {
    let kept = run.join(PRIOR);
    match prior {
        Some(prior) => prior.write(run)?,
        None if !args.resume && kept.exists() => std::fs::remove_file(&kept).map_err(Error::io("remove", &kept))?,
        None => {}
    }
    Ok(VesselPrior::read(run)?.map(Arc::new))
}

fn prepare_directory(run: &Path, args: &TrainArgs) -> Result<()> {
    if args.resume || !run.exists() {
        return Ok(());
    }
    let old = checkpoint::list(run)?;
    if old.is_empty() {
        return Ok(());
    }
    if !args.force {
        return Err(Error::config(
            "--out",
            run.display(),
            "already contains a run: continue it with --resume, or start over with --force",
        ));
    }
    for (_, path) in old {
        std::fs::remove_file(&path).map_err(Error::io("remove", &path))?;
    }
    Ok(())
}

fn export_hull(config: &Config, dataset: &Dataset, file: &Path) -> Result<()> {
    let plan = Plan::new(config, dataset)?;
    plan.notes.iter().for_each(|note| eprintln!("{note}"));
    let hull = plan.hull.ok_or_else(|| {
        Error::config(
            "hull",
            "",
            "this configuration does not use a motion hull, or none can be computed for this dataset",
        )
    })?;
    Ok(nrrd::write(file, &hull.to_volume(), "phases at which a cell may contain moving vessels")?)
}
