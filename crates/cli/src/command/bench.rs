//! `bench`: compares iterations, passes and renderings with the device's own limits and with the paper's 37 minutes.

use crate::args::options::{ConfigArgs, GlobalOptions};
use crate::pages::bench_report::{FullRun, Host, Report, compare, print};
use crate::viewer::frame_rates::{FrameRate, measure_frame_rates};
use clap::Args;
use nertca_vk::bench::peaks::peaks;
use nertca_vk::checkpoint::newest_model;
use nertca_vk::choice::Choice;
use nertca_vk::config::Config;
use nertca_vk::config::sections::Train;
use nertca_vk::error::{Error, Result};
use nertca_vk::fitting::ledger::Ledger;
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::methods;
use nertca_vk::model::component::Component;
use nertca_vk::network::cost::NetworkCost;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::train::dry_run::{DryRun, dry_run};
use nertca_vk::train::timing::{GaussianSubject, GaussianTiming, Length, Pace, Passes, Subject, Timing};
use nertca_vk::train::trainer::Trainer;
use nertca_vk_phantom::dataset::{PhantomOptions, Setting, make};
use nertca_vk_phantom::degradations::Degradations;
use nertca_vk_phantom::views::ViewAngles;
use nertca_vk_runs::run::events::Event;
use nertca_vk_runs::run::reconstruct::{RunOptions, reconstruct};
use nertca_vk_runs::run::score::{ScoreOptions, evaluate_model};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

/// Arguments of `bench`.
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// Dataset directory; by default a phantom that is made for the measurement.
    pub data: Option<PathBuf>,
    /// Hyper-parameters.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Seconds of iterations before the first timed one.
    #[arg(long, value_name = "SECONDS", default_value_t = 5.0, value_parser = seconds)]
    pub warm_up: f64,
    /// Total seconds of all timed repeats; fits of Gaussians are timed as a whole.
    #[arg(long, value_name = "SECONDS", default_value_t = 10.0, value_parser = seconds, conflicts_with = "iterations")]
    pub sample: f64,
    /// Iterations of each timed repeat, instead of seconds; for Gaussians, the first iterations of a fit.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=2000))]
    pub iterations: Option<u32>,
    /// Number of timed repeats.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=10))]
    pub repeats: u32,
    /// Also run the whole reconstruction, with time-to-Dice; a dry run comes first.
    #[arg(long)]
    pub full: bool,
    /// Only run through all events of the schedule (delay, open window, density control), in a short run of full-size batches.
    #[arg(long, conflicts_with_all = ["full", "kernels", "render", "compare"])]
    pub dry_run: bool,
    /// List the time of each pass.
    #[arg(long)]
    pub kernels: bool,
    /// Also measure frames per second of renderings.
    #[arg(long)]
    pub render: bool,
    /// Write all results, with raw samples, configuration and commit, as JSON.
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Compare with the file of an earlier --json.
    #[arg(long, value_name = "FILE")]
    pub compare: Option<PathBuf>,
}

/// Maximum number of iterations timed pass by pass.
const PROFILED: u32 = 8;
/// Longest time for a measurement, seconds: one hour.
const MAX_SECONDS: f64 = 3600.0;
/// Work that times of iterations do not include.
const LEFT_OUT: &str = "opening the device, compiling, reading data, calibration, hull, validation, checkpoints";

fn seconds(text: &str) -> std::result::Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.0..=MAX_SECONDS).contains(&seconds) => Ok(seconds),
        _ => Err(format!("is not a number of seconds from 0 to {MAX_SECONDS}")),
    }
}

impl BenchArgs {
    fn pace(&self) -> Pace {
        let share = self.sample / f64::from(self.repeats);
        let length = self.iterations.map_or(Length::Seconds(share), Length::Iterations);
        Pace { warm_up_s: self.warm_up, repeats: self.repeats, length }
    }

    /// Returns the number of iterations timed pass by pass.
    fn profiled(&self) -> u32 {
        self.iterations.map_or(PROFILED, |n| n.min(PROFILED))
    }
}

/// Measures, prints the results and writes the report.
pub fn run(global: &GlobalOptions, args: &BenchArgs) -> Result<()> {
    let config = args.config.load([])?;
    let compared = args.compare.as_deref().map(read_report).transpose()?;
    let gpu = global.open_device()?;
    let scratch = tempfile::tempdir().map_err(Error::io("create", std::env::temp_dir()))?;
    let dataset = match &args.data {
        Some(path) => Dataset::open(path)?,
        None => default_phantom(&gpu, scratch.path())?,
    };
    if args.dry_run {
        let done = dry_run_of(global, &gpu, &config, &dataset)?;
        if let Some(file) = &args.json {
            write_json(file, &done)?;
        }
        return global.close_device(&gpu);
    }
    let report = measure(global, args, &gpu, &config, &dataset, scratch.path())?;
    print(&report, args.kernels);
    if let Some(other) = compared {
        compare(&report, &other);
    }
    if let Some(file) = &args.json {
        write_json(file, &report)?;
    }
    global.close_device(&gpu)
}

fn write_json(file: &Path, value: &impl serde::Serialize) -> Result<()> {
    Ok(nertca_vk::files::write_atomic(file, nertca_vk::files::pretty_json(value)?.as_bytes())?)
}

/// Performs a dry run, and prints a line about the events it covered.
fn dry_run_of(global: &GlobalOptions, gpu: &Gpu, config: &Config, dataset: &Dataset) -> Result<DryRun> {
    let max_buffer = u64::from(gpu.info().max_storage_buffer_range);
    let estimate = methods::of(config).abilities.estimate_memory;
    if let Some(memory) = estimate.and_then(|estimate| estimate(config, dataset, max_buffer)) {
        let mib = |bytes: u64| bytes >> 20;
        out!(
            "memory of the whole run: about {} MiB of the host and {} MiB of the device, or {} MiB where they share it",
            mib(memory.host_bytes),
            mib(memory.device_bytes),
            mib(memory.together_bytes)
        );
    }
    let done = dry_run(gpu, config, dataset, &global.training_tuning(gpu, config, dataset)?)?;
    out!(
        "dry run: {} iterations around the schedule's events at {:?} in {:.1} s; the last loss is {:.3e}",
        done.iterations,
        done.events,
        done.seconds,
        done.last_loss
    );
    Ok(done)
}

fn read_report(file: &Path) -> Result<Report> {
    let text = std::fs::read(file).map_err(Error::io("read", file))?;
    serde_json::from_slice(&text)
        .map_err(|e| Error::data(file, "JSON", format!("{e}; a file that `bench --json` wrote is needed")))
}

/// Makes the default phantom of `nertca-vk phantom`.
fn default_phantom(gpu: &Gpu, scratch: &Path) -> Result<Dataset> {
    let directory = scratch.join("phantom");
    let options = PhantomOptions {
        setting: Setting::SmallXcat,
        size: 100,
        phases: 10,
        views: ViewAngles::published(4)?,
        seed: 1,
        stenoses: Vec::new(),
        degradations: Degradations::default(),
        layout: Layout::Native,
        anatomy: None,
        volumes_every: None,
    };
    make(gpu, &options, &directory, |_, _, _| {})?;
    Dataset::open(&directory)
}

fn measure(
    global: &GlobalOptions,
    args: &BenchArgs,
    gpu: &Gpu,
    config: &Config,
    dataset: &Dataset,
    scratch: &Path,
) -> Result<Report> {
    let dry_run = args.full.then(|| dry_run_of(global, gpu, config, dataset)).transpose()?;
    let tuning = global.training_tuning(gpu, config, dataset)?;
    let timings = match methods::of(config).abilities.time_gaussians.is_some() {
        true => time_gaussians(args, gpu, config, dataset, &tuning)?,
        false => time_network(args, gpu, config, dataset, &tuning)?,
    };
    // The device is warm by now.
    let peaks = peaks(gpu)?;
    let frame_rates = match args.render {
        false => Vec::new(),
        true => frame_rates(gpu, config, dataset, &tuning)?,
    };
    let full = match args.full {
        false => None,
        true => Some(run_whole(gpu, config, dataset, &tuning, scratch)?),
    };
    Ok(Report {
        version: env!("CARGO_PKG_VERSION").into(),
        commit: nertca_vk_study::COMMIT.into(),
        device: gpu.info().name.clone(),
        driver: gpu.info().driver.clone(),
        paths: timings.paths,
        preset: config.preset.name().into(),
        config: serde_json::to_value(config).map_err(internal)?,
        rays: timings.rays,
        of_the_paper: is_of_the_paper(config),
        peaks,
        network_cost: timings.network_cost,
        gaussians: timings.gaussians,
        before: timings.before,
        after: timings.after,
        whole_run_s: timings.whole_run_s,
        passes_ms: timings.passes.iter().map(|(name, pass)| (name.clone(), pass.ms)).collect(),
        passes_per_iteration: timings.passes.into_iter().map(|(name, pass)| (name, pass.count)).collect(),
        barriers_per_iteration: timings.barriers,
        work: timings.work,
        frame_rates,
        full,
        dry_run,
        left_out: LEFT_OUT.into(),
        tuning: serde_json::to_value(&tuning).map_err(internal)?,
        host: Host::this(),
    })
}

/// Measures frames per second of the initial fields: the cost of a network does not depend on its parameters.
fn frame_rates(gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning) -> Result<Vec<FrameRate>> {
    let mut trainer = Trainer::new(gpu, Plan::new(config, dataset)?, dataset, tuning.clone())?;
    // Gaussians are fitted first, because they cost more the larger they are.
    while trainer.step() < config.gaussian_iterations() {
        trainer.advance(config.gaussian_iterations())?;
    }
    let model = trainer.model()?;
    let renderer = Arc::new(Renderer::new(gpu, &model, tuning.clone())?);
    measure_frame_rates(&renderer, &model, Component::Total, &[200, 512], 2.0)
}

/// Executes the whole run.
fn run_whole(gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning, scratch: &Path) -> Result<FullRun> {
    let directory = scratch.join("run");
    let never = AtomicBool::new(false);
    let options = RunOptions { tuning, run: &directory, resume: false, stop_at: None, cancel: &never };
    let (mut curve, mut train_s, mut elapsed_s) = (Vec::new(), 0.0, 0.0);
    let (mut stages, before) = (Vec::new(), gpu.calls());
    reconstruct(gpu, config, dataset, &options, &mut |event| match event {
        Event::Validation { step, train_s, dice_dynamic, .. } => curve.push((*step, *train_s, *dice_dynamic)),
        Event::Finished { train_s: t, elapsed_s: e, stages: s, .. } => {
            (train_s, elapsed_s) = (*t, *e);
            stages.clone_from(s);
        }
        _ => {}
    })?;
    let calls = Some(gpu.calls().since(&before));
    let score = match dataset.validation().is_empty() {
        true => None,
        false => {
            let scoring = ScoreOptions { threshold_per_mm: None, pictures: None, cancel: &never };
            Some(evaluate_model(gpu, tuning, &newest_model(&directory)?, dataset, &scoring, &mut |_| ())?)
        }
    };
    let dice = score.as_ref().and_then(|s| s.dice.dynamic);
    Ok(FullRun { train_s, elapsed_s, curve, dice, psnr: score.map(|s| s.psnr), stages, calls })
}

/// Tells whether iterations do the same work as the paper's, so that a comparison with its 37 minutes is fair whatever the
/// result: all settings that affect the work are those of one of its presets.
fn is_of_the_paper(config: &Config) -> bool {
    if !config.preset.is_published() {
        return false;
    }
    let mut same = Config::preset(config.preset);
    same.seed = config.seed;
    same.train = Train { iterations: same.train.iterations, ..config.train.clone() };
    same == *config
}

/// Timings of a run.
struct Timings {
    paths: Vec<String>,
    rays: u32,
    network_cost: Option<NetworkCost>,
    gaussians: Option<GaussianTiming>,
    before: Option<Timing>,
    after: Option<Timing>,
    whole_run_s: f64,
    passes: Passes,
    barriers: Option<u32>,
    work: Ledger,
}

fn internal(error: serde_json::Error) -> Error {
    Error::Internal(error.to_string())
}

/// Times a run whose dynamic field is a network, or whose method has its own module.
fn time_network(args: &BenchArgs, gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning) -> Result<Timings> {
    let delay = config.fields().map_or(0, |settings| settings.dynamic.delay).min(config.train.iterations);
    let before = match delay {
        0 => None,
        _ => Some(Subject::new(gpu, config, dataset, tuning, false)?.time(&args.pace())?),
    };
    let mut subject = Subject::new(gpu, config, dataset, tuning, true)?;
    let after = subject.time(&args.pace())?;
    let whole_run_s = 1e-3
        * (before.as_ref().map_or(0.0, Timing::median) * f64::from(delay)
            + after.median() * f64::from(config.train.iterations - delay));
    Ok(Timings {
        paths: subject.notes(),
        rays: (methods::of(config).rays_per_iteration)(config),
        network_cost: config.has_network().then(|| subject.cost()),
        work: if config.has_network() { subject.work(after.live_samples) } else { Ledger::new() },
        gaussians: None,
        before,
        after: Some(after),
        whole_run_s,
        barriers: subject.barriers(),
        passes: subject.passes(args.profiled())?,
    })
}

/// Times a run whose dynamic field is made of Gaussians: their iterations, then those of the static field.
fn time_gaussians(args: &BenchArgs, gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning) -> Result<Timings> {
    let (pace, profiled) = (args.pace(), args.profiled());
    let fits = GaussianSubject::new(gpu, config, dataset, pace.length, profiled)?;
    let (gaussians, mut passes) = fits.time(&pace, profiled)?;
    let notes = fits.notes().to_vec();
    drop(fits);
    let whole_fit_s = |iterations: u32| gaussians.preparation_s + 1e-3 * gaussians.median() * f64::from(iterations);
    if config.fields().is_none() {
        return Ok(Timings {
            paths: notes,
            rays: 0,
            network_cost: None,
            whole_run_s: whole_fit_s(config.train.iterations),
            gaussians: Some(gaussians),
            before: None,
            after: None,
            passes,
            barriers: None,
            work: Ledger::new(),
        });
    }
    let mut static_fit = Subject::new(gpu, config, dataset, tuning, false)?;
    let before = static_fit.time(&pace)?;
    passes.extend(static_fit.passes(profiled)?);
    let first = config.gaussian_iterations();
    let whole_run_s = whole_fit_s(first) + 1e-3 * before.median() * f64::from(config.train.iterations - first);
    Ok(Timings {
        paths: static_fit.notes(),
        rays: static_fit.rays(),
        network_cost: None,
        gaussians: Some(gaussians),
        before: Some(before),
        after: None,
        whole_run_s,
        passes,
        barriers: static_fit.barriers(),
        // The passes after the Gaussians are those of the static field, whose stages have no counted work except the optimiser;
        // the network is not evaluated and has no samples.
        work: Ledger::new(),
    })
}
