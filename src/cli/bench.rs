//! `bench`: iterations, passes and renderings against the device's own limits and the paper's 37 minutes.

use super::args::{BenchArgs, Cli};
use super::frame_rates::{FrameRate, measure_frame_rates, print_frame_rates};
use nertca_vk::bench::{self, PAPER_SECONDS, Peaks};
use nertca_vk::choice::Choice;
use nertca_vk::config::Config;
use nertca_vk::error::{Error, Result};
use nertca_vk::gpu::device::Gpu;
use nertca_vk::model::checkpoint::newest_model;
use nertca_vk::model::component::Component;
use nertca_vk::network::cost::NetworkCost;
use nertca_vk::phantom::dataset::{PhantomOptions, Setting, make};
use nertca_vk::phantom::views::ViewAngles;
use nertca_vk::plan::Plan;
use nertca_vk::render::renderer::Renderer;
use nertca_vk::run::events::Event;
use nertca_vk::run::reconstruct::{RunOptions, reconstruct};
use nertca_vk::run::score::{ScoreOptions, evaluate_model};
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::train::timing::{Subject, Timing};
use nertca_vk::train::trainer::Trainer;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

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
    /// Operations of the network per live sample.
    network_cost: NetworkCost,
    /// Iterations before the network starts; none without a delay.
    before: Option<Timing>,
    /// Iterations with the network.
    after: Timing,
    /// Iterations of the whole run times the medians.
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
        photons: None,
        respiration_mm: 0.0,
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
    let delay = config.dynamic.delay.min(config.train.iterations);
    let before = match delay {
        0 => None,
        _ => Some(Subject::new(gpu, config, dataset, &tuning, false)?.time(args.iterations, args.repeats)?),
    };
    let mut subject = Subject::new(gpu, config, dataset, &tuning, true)?;
    let after = subject.time(args.iterations, args.repeats)?;
    let passes_ms = subject.passes(PROFILED.min(args.iterations))?;
    let whole_run_s = 1e-3
        * (before.as_ref().map_or(0.0, Timing::median) * f64::from(delay)
            + after.median() * f64::from(config.train.iterations - delay));
    let (paths, rays, network_cost) = (subject.notes(), subject.rays(), subject.cost());
    drop(subject);
    let frame_rates = match args.render {
        false => Vec::new(),
        true => {
            // Any parameters cost the same, so untrained ones serve.
            let mut trainer = Trainer::new(gpu, Plan::new(config, dataset)?, dataset, tuning.clone())?;
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
        paths,
        preset: config.preset.name().into(),
        config: serde_json::to_value(config).map_err(|e| Error::Internal(e.to_string()))?,
        rays,
        peaks,
        network_cost,
        before,
        after,
        whole_run_s,
        passes_ms,
        frame_rates,
        full,
    })
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
    let line = |name: &str, t: &Timing| {
        let (low, high) = t.ms.iter().fold((f64::INFINITY, 0f64), |(l, h), ms| (l.min(*ms), h.max(*ms)));
        let cpu = t.host_cpu_share.map_or(String::new(), |s| format!(", process uses {s:.2} CPUs"));
        out!("{name}: {:.3} ms per iteration (median of {}; {low:.3} to {high:.3}){cpu}", t.median(), t.ms.len());
    };
    out!("preset {}, {} rays per iteration", report.preset, report.rays);
    if let Some(before) = &report.before {
        line("before the network starts", before);
    }
    line("with the network         ", &report.after);
    let (ms, live) = (report.after.median(), report.after.live_samples);
    out!(
        "  {live} live samples: {:.3e} samples/s, {:.4} TFLOP/s over whole iterations",
        live as f64 / ms * 1e3,
        report.after.network_gflop / ms
    );
    let network_ms: f64 = report.passes_ms.iter().filter(|(name, _)| is_network(name)).map(|(_, ms)| ms).sum();
    if network_ms > 0.0 {
        let tflops = report.after.network_gflop / network_ms;
        let of = |peak: f64| 100.0 * tflops / peak;
        let share = p.matrix_tflops.map_or(String::new(), |m| format!(", {:.0} % of the matrix peak", of(m)));
        out!("  network passes alone: {tflops:.4} TFLOP/s: {:.0} % of the f32 peak{share}", of(p.f32_tflops));
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

fn compare(this: &Report, other: &Report) {
    out!("compared with {} on {} (ratios: this / other):", other.commit, other.device);
    if (&this.device, &this.driver) != (&other.device, &other.driver) {
        out!("  another device or driver");
    }
    if this.config != other.config || this.rays != other.rays {
        out!("  another configuration: see both files");
    }
    let ratio = |name: &str, a: f64, b: f64| out!("  {name:32} {:6.3}  ({a:.3} / {b:.3})", a / b);
    if let (Some(a), Some(b)) = (&this.before, &other.before) {
        ratio("before the network, ms", a.median(), b.median());
    }
    ratio("with the network, ms", this.after.median(), other.after.median());
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
