//! `bench`: iterations, passes and renderings against the device's own limits and the paper's 37 minutes.

use super::args::{Cli, ConfigArgs};
use super::frame_rates::{FrameRate, measure_frame_rates, print_frame_rates};
use clap::Args;
use nertca_vk::bench::{self, PAPER_SECONDS, Peaks};
use nertca_vk::choice::Choice;
use nertca_vk::config::Config;
use nertca_vk::error::{Error, Result};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::kernels::tuning::Tuning;
use nertca_vk::model::checkpoint::newest_model;
use nertca_vk::model::component::Component;
use nertca_vk::network::cost::NetworkCost;
use nertca_vk::phantom::dataset::{PhantomOptions, Setting, make};
use nertca_vk::phantom::degradations::Degradations;
use nertca_vk::phantom::views::ViewAngles;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::run::events::Event;
use nertca_vk::run::reconstruct::{RunOptions, reconstruct};
use nertca_vk::run::score::{ScoreOptions, evaluate_model};
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::train::timing::{GaussianSubject, GaussianTiming, Subject, Timing};
use nertca_vk::train::trainer::Trainer;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

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

/// Iterations timed pass by pass.
const PROFILED: u32 = 8;

/// Everything measured; what `--json` writes and `--compare` reads.
#[derive(Serialize, Deserialize)]
struct Report {
    version: String,
    commit: String,
    device: String,
    driver: String,
    /// Choices about data and device: the paths taken.
    paths: Vec<String>,
    preset: String,
    config: serde_json::Value,
    rays: u32,
    peaks: Peaks,
    /// Operations of the network per live sample; none where Gaussians move.
    network_cost: Option<NetworkCost>,
    /// Iterations of Gaussians; none where the network moves, and in reports of versions that had none.
    #[serde(default)]
    gaussians: Option<GaussianTiming>,
    /// Iterations of the still field alone: those before the network starts, none without a delay; or those after Gaussians.
    before: Option<Timing>,
    /// Iterations with the network; none where Gaussians move.
    after: Option<Timing>,
    /// Iterations of the whole run times the medians, and what Gaussians need before their first.
    whole_run_s: f64,
    /// Milliseconds of each pass, kept apart.
    passes_ms: BTreeMap<String, f64>,
    frame_rates: Vec<FrameRate>,
    /// The whole run, really run.
    full: Option<FullRun>,
}

/// A whole run.
#[derive(Serialize, Deserialize)]
struct FullRun {
    /// Seconds of training, validation excluded.
    train_s: f64,
    /// Seconds of everything.
    elapsed_s: f64,
    /// Validations on the way: iterations, seconds of training, Dice of the dynamic field.
    curve: Vec<(u32, f64, Option<f64>)>,
    /// Dice of the dynamic field on all unseen images.
    dice: Option<f64>,
    /// PSNR on them, dB.
    psnr: f64,
}

/// Measures.
pub fn run(cli: &Cli, args: &BenchArgs) -> Result<()> {
    let config = args.config.load([])?;
    let compared = args.compare.as_deref().map(read_report).transpose()?;
    let gpu = cli.open_device()?;
    let scratch = tempfile::tempdir().map_err(Error::io("create", std::env::temp_dir()))?;
    let dataset = match &args.data {
        Some(path) => Dataset::open(path)?,
        None => default_phantom(&gpu, scratch.path())?,
    };
    let report = measure(cli, args, &gpu, &config, &dataset, scratch.path())?;
    print(&report, args.kernels);
    if let Some(other) = compared {
        compare(&report, &other);
    }
    if let Some(file) = &args.json {
        let text = nertca_vk::files::pretty_json(&report)?;
        nertca_vk::files::write_atomic(file, text.as_bytes())?;
    }
    cli.close_device(&gpu)
}

fn read_report(file: &Path) -> Result<Report> {
    let text = std::fs::read(file).map_err(Error::io("read", file))?;
    serde_json::from_slice(&text).map_err(|e| Error::data(file, "JSON", format!("{e}; is it from `bench --json`?")))
}

/// The default phantom of `nertca-vk phantom`.
fn default_phantom(gpu: &Gpu, scratch: &Path) -> Result<Dataset> {
    let directory = scratch.join("phantom");
    let options = PhantomOptions {
        setting: Setting::Xcat,
        size: 100,
        phases: 10,
        views: ViewAngles::published(4)?,
        seed: 1,
        degradations: Degradations::default(),
        layout: Layout::Native,
        anatomy: None,
        volumes: false,
    };
    make(gpu, &options, &directory, |_, _, _| {})?;
    Dataset::open(&directory)
}

fn measure(
    cli: &Cli,
    args: &BenchArgs,
    gpu: &Gpu,
    config: &Config,
    dataset: &Dataset,
    scratch: &Path,
) -> Result<Report> {
    let tuning = cli.training_tuning(gpu, config, dataset)?;
    let peaks = bench::peaks(gpu)?;
    let timings = match config.gaussians_move() {
        true => time_gaussians(args, gpu, config, dataset, &tuning)?,
        false => time_network(args, gpu, config, dataset, &tuning)?,
    };
    let frame_rates = match args.render {
        false => Vec::new(),
        true => {
            // Any parameters cost the same, so untrained ones serve.
            let mut trainer = Trainer::new(gpu, Plan::new(config, dataset)?, dataset, tuning.clone())?;
            // But for Gaussians, which cost the more the larger they are.
            while trainer.step() < config.gaussian_iterations() {
                trainer.advance(config.gaussian_iterations())?;
            }
            let model = trainer.model()?;
            let renderer = Arc::new(Renderer::new(gpu, &model, tuning.clone())?);
            measure_frame_rates(&renderer, &model, Component::Total, &[200, 512], 2.0)?
        }
    };
    let full = match args.full {
        false => None,
        true => {
            let directory = scratch.join("run");
            let never = AtomicBool::new(false);
            let options = RunOptions { tuning: &tuning, run: &directory, resume: false, stop_at: None, cancel: &never };
            let (mut curve, mut train_s, mut elapsed_s) = (Vec::new(), 0.0, 0.0);
            reconstruct(gpu, config, dataset, &options, &mut |event| match event {
                Event::Validation { step, train_s, dice_dynamic, .. } => curve.push((*step, *train_s, *dice_dynamic)),
                Event::Finished { train_s: t, elapsed_s: e, .. } => (train_s, elapsed_s) = (*t, *e),
                _ => {}
            })?;
            let score = match dataset.validation().is_empty() {
                true => None,
                false => {
                    let scoring = ScoreOptions { threshold_per_mm: None, pictures: None, cancel: &never };
                    Some(evaluate_model(gpu, &tuning, &newest_model(&directory)?, dataset, &scoring, &mut |_| ())?)
                }
            };
            Some(FullRun {
                train_s,
                elapsed_s,
                curve,
                dice: score.as_ref().and_then(|s| s.dice.dynamic),
                psnr: score.map_or(f64::NAN, |s| s.psnr),
            })
        }
    };
    Ok(Report {
        version: env!("CARGO_PKG_VERSION").into(),
        commit: env!("NERTCA_COMMIT").into(),
        device: gpu.info().name.clone(),
        driver: gpu.info().driver.clone(),
        paths: timings.paths,
        preset: config.preset.name().into(),
        config: serde_json::to_value(config).map_err(|e| Error::Internal(e.to_string()))?,
        rays: timings.rays,
        peaks,
        network_cost: timings.network_cost,
        gaussians: timings.gaussians,
        before: timings.before,
        after: timings.after,
        whole_run_s: timings.whole_run_s,
        passes_ms: timings.passes_ms,
        frame_rates,
        full,
    })
}

/// What was timed of a run.
struct Timings {
    paths: Vec<String>,
    rays: u32,
    network_cost: Option<NetworkCost>,
    gaussians: Option<GaussianTiming>,
    before: Option<Timing>,
    after: Option<Timing>,
    whole_run_s: f64,
    passes_ms: BTreeMap<String, f64>,
}

/// Times a run whose moving field is the network.
fn time_network(args: &BenchArgs, gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning) -> Result<Timings> {
    let delay = config.dynamic.delay.min(config.train.iterations);
    let before = match delay {
        0 => None,
        _ => Some(Subject::new(gpu, config, dataset, tuning, false)?.time(args.iterations, args.repeats)?),
    };
    let mut subject = Subject::new(gpu, config, dataset, tuning, true)?;
    let after = subject.time(args.iterations, args.repeats)?;
    let whole_run_s = 1e-3
        * (before.as_ref().map_or(0.0, Timing::median) * f64::from(delay)
            + after.median() * f64::from(config.train.iterations - delay));
    Ok(Timings {
        paths: subject.notes(),
        rays: subject.rays(),
        network_cost: Some(subject.cost()),
        gaussians: None,
        before,
        after: Some(after),
        whole_run_s,
        passes_ms: subject.passes(PROFILED.min(args.iterations))?,
    })
}

/// Times a run whose moving field is made of Gaussians: their iterations, then those of the still field.
fn time_gaussians(args: &BenchArgs, gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning) -> Result<Timings> {
    let profiled = PROFILED.min(args.iterations);
    let mut fit = GaussianSubject::new(gpu, config, dataset, args.iterations * args.repeats + profiled)?;
    let gaussians = fit.time(args.iterations, args.repeats)?;
    let mut passes_ms = fit.passes(profiled)?;
    let notes = fit.notes().to_vec();
    drop(fit);
    let whole_fit_s = |iterations: u32| gaussians.preparation_s + 1e-3 * gaussians.median() * f64::from(iterations);
    if config.is_r2() {
        return Ok(Timings {
            paths: notes,
            rays: 0,
            network_cost: None,
            whole_run_s: whole_fit_s(config.train.iterations),
            gaussians: Some(gaussians),
            before: None,
            after: None,
            passes_ms,
        });
    }
    let mut still = Subject::new(gpu, config, dataset, tuning, false)?;
    let before = still.time(args.iterations, args.repeats)?;
    passes_ms.extend(still.passes(profiled)?);
    let first = config.gaussian_iterations();
    let whole_run_s = whole_fit_s(first) + 1e-3 * before.median() * f64::from(config.train.iterations - first);
    Ok(Timings {
        paths: still.notes(),
        rays: still.rays(),
        network_cost: None,
        gaussians: Some(gaussians),
        before: Some(before),
        after: None,
        whole_run_s,
        passes_ms,
    })
}

/// Whether a pass is one over pairs of a Gaussian and a pixel, whose operations are counted.
fn is_over_pairs(pass: &str) -> bool {
    ["gaussian_splat", "gaussian_moments"].iter().any(|stage| pass.starts_with(stage))
}

/// Whether a pass belongs to the network whose operations are counted.
fn is_network(pass: &str) -> bool {
    pass.starts_with("mlp_layer") || pass.starts_with("mlp_out") || pass.starts_with("mlp_fused")
}

fn clock(seconds: f64) -> String {
    format!("{:02}:{:02}", seconds as u64 / 60, seconds as u64 % 60)
}

fn print(report: &Report, kernels: bool) {
    out!("{} ({}), nertca-vk {} {}", report.device, report.driver, report.version, report.commit);
    report.paths.iter().for_each(|p| out!("- {p}"));
    let p = &report.peaks;
    let matrix = p.matrix_tflops.map_or("none".to_owned(), |t| format!("{t:.3} TFLOP/s"));
    out!("peaks: f32 {:.3} TFLOP/s, f16 matrices {matrix}, copy {:.1} GB/s", p.f32_tflops, p.copy_gb_per_s);
    match report.rays {
        // Whole images are compared.
        0 => out!("preset {}", report.preset),
        rays => out!("preset {}, {rays} rays per iteration", report.preset),
    }
    if let Some(gaussians) = &report.gaussians {
        print_gaussians(report, gaussians);
    }
    if let Some(before) = &report.before {
        let name = if report.gaussians.is_some() { "still field after them" } else { "before the network starts" };
        print_times(name, &before.ms, before.median(), before.host_cpu_share);
    }
    if let Some(after) = &report.after {
        print_network(report, after);
    }
    let speedup = PAPER_SECONDS / report.whole_run_s;
    out!("whole run: {} against 37:00 of the paper, extrapolated: {speedup:.3} x as fast", clock(report.whole_run_s));
    if let Some(full) = &report.full {
        out!(
            "whole run, really run: {:.1} s of training ({:.2} x as fast as 37:00), {:.1} s in all; Dice {}, PSNR {:.2} dB",
            full.train_s,
            PAPER_SECONDS / full.train_s,
            full.elapsed_s,
            full.dice.map_or("-".into(), |d| format!("{d:.3}")),
            full.psnr
        );
        for (step, seconds, dice) in &full.curve {
            out!("  {step:6} iterations {seconds:8.1} s: Dice {}", dice.map_or("-".into(), |d| format!("{d:.3}")));
        }
    }
    print_frame_rates(&report.frame_rates);
    if kernels {
        let mut passes: Vec<_> = report.passes_ms.iter().collect();
        passes.sort_by(|a, b| b.1.total_cmp(a.1));
        passes.iter().for_each(|(name, ms)| out!("{name:32} {ms:9.3} ms"));
    }
}

/// Times of an iteration, in a line.
fn print_times(name: &str, ms: &[f64], median: f64, host_cpu_share: Option<f64>) {
    let (low, high) = ms.iter().fold((f64::INFINITY, 0f64), |(l, h), ms| (l.min(*ms), h.max(*ms)));
    let cpu = host_cpu_share.map_or(String::new(), |s| format!(", process uses {s:.2} CPUs"));
    out!("{name:25}: {median:.3} ms per iteration (median of {}; {low:.3} to {high:.3}){cpu}", ms.len());
}

/// Milliseconds of some passes together.
fn ms_of(report: &Report, belongs: impl Fn(&str) -> bool) -> f64 {
    report.passes_ms.iter().filter(|(name, _)| belongs(name)).map(|(_, ms)| ms).sum()
}

fn print_gaussians(report: &Report, gaussians: &GaussianTiming) {
    let GaussianTiming { form, count, work, .. } = gaussians;
    out!("{count} Gaussians, form {form}; {:.2} s before their first iteration", gaussians.preparation_s);
    let ms = gaussians.median();
    print_times("Gaussians", &gaussians.ms, ms, gaussians.host_cpu_share);
    out!(
        "  {} pairs of a Gaussian and a pixel: {:.3e} pairs/s, {:.4} TFLOP/s and {:.2} GB/s over whole iterations",
        work.pairs,
        work.pairs as f64 / ms * 1e3,
        work.gflop / ms,
        work.megabytes / ms
    );
    let pairs_ms = ms_of(report, is_over_pairs);
    if pairs_ms > 0.0 {
        let tflops = work.gflop / pairs_ms;
        let share = 100.0 * tflops / report.peaks.f32_tflops;
        out!("  passes over pairs alone: {tflops:.4} TFLOP/s: {share:.0} % of the f32 peak");
    }
}

fn print_network(report: &Report, after: &Timing) {
    let ms = after.median();
    print_times("with the network", &after.ms, ms, after.host_cpu_share);
    let live = after.live_samples;
    out!(
        "  {live} live samples: {:.3e} samples/s, {:.4} TFLOP/s over whole iterations",
        live as f64 / ms * 1e3,
        after.network_gflop / ms
    );
    let network_ms = ms_of(report, is_network);
    if network_ms > 0.0 {
        let tflops = after.network_gflop / network_ms;
        let of = |peak: f64| 100.0 * tflops / peak;
        let matrices = report.peaks.matrix_tflops;
        let share = matrices.map_or(String::new(), |m| format!(", {:.0} % of the matrix peak", of(m)));
        out!(
            "  network passes alone: {tflops:.4} TFLOP/s: {:.0} % of the f32 peak{share}",
            of(report.peaks.f32_tflops)
        );
    }
}

fn compare(this: &Report, other: &Report) {
    out!("compared with {} on {} (ratios: this / other):", other.commit, other.device);
    if (&this.device, &this.driver) != (&other.device, &other.driver) {
        out!("  another device or driver");
    }
    if this.config != other.config || this.rays != other.rays {
        out!("  another configuration: see both files");
    }
    let ratio = |name: &str, a: f64, b: f64| out!("  {name:32} {:6.3}  ({a:.3} / {b:.3})", a / b);
    if let (Some(a), Some(b)) = (&this.gaussians, &other.gaussians) {
        ratio("Gaussians, ms", a.median(), b.median());
        ratio("before the first of them, s", a.preparation_s, b.preparation_s);
    }
    if let (Some(a), Some(b)) = (&this.before, &other.before) {
        ratio("without the network, ms", a.median(), b.median());
    }
    if let (Some(a), Some(b)) = (&this.after, &other.after) {
        ratio("with the network, ms", a.median(), b.median());
    }
    ratio("whole run, extrapolated, s", this.whole_run_s, other.whole_run_s);
    for (name, ms) in &this.passes_ms {
        if let Some(theirs) = other.passes_ms.get(name) {
            ratio(name, *ms, *theirs);
        }
    }
    for rate in &this.frame_rates {
        if let Some(theirs) = other.frame_rates.iter().find(|r| (&r.way, r.size) == (&rate.way, rate.size)) {
            ratio(&format!("{} {}, frames/s", rate.way, rate.size), rate.fps, theirs.fps);
        }
    }
}
