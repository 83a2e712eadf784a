//! Results of `bench`: the file that it writes and compares with, and the printed form.

use crate::viewer::frame_rates::{FrameRate, print_frame_rates};
use nertca_vk::bench::PAPER_SECONDS;
use nertca_vk::bench::peaks::Peaks;
use nertca_vk::fitting::ledger::{Ledger, StageWork, of_pass};
use nertca_vk::gpu::calls::Calls;
use nertca_vk::gpu::sensors::{Readings, Span, host_processor};
use nertca_vk::network::cost::NetworkCost;
use nertca_vk::train::dry_run::DryRun;
use nertca_vk::train::timing::{GaussianTiming, Timing};
use nertca_vk_runs::run::events::StageTime;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// All results; `--json` writes them and `--compare` reads them.
#[derive(Serialize, Deserialize)]
pub struct Report {
    pub version: String,
    pub commit: String,
    pub device: String,
    pub driver: String,
    /// Choices made for data and device, such as computation paths.
    pub paths: Vec<String>,
    pub preset: String,
    pub config: serde_json::Value,
    pub rays: u32,
    /// Whether iterations do the same work as the paper's; false in older reports, which do not say.
    #[serde(default)]
    pub of_the_paper: bool,
    pub peaks: Peaks,
    /// Operations of the network per live sample; none where Gaussians move.
    pub network_cost: Option<NetworkCost>,
    /// Iterations of Gaussians; none where the network moves, and in reports of versions without Gaussians.
    #[serde(default)]
    pub gaussians: Option<GaussianTiming>,
    /// Iterations of the static field alone: those before the network starts, none without a delay; or those after Gaussians.
    pub before: Option<Timing>,
    /// Iterations with the network; none where Gaussians move.
    pub after: Option<Timing>,
    /// Extrapolated seconds of the whole run: numbers of iterations times the medians, plus the preparation of Gaussians.
    pub whole_run_s: f64,
    /// Milliseconds of each pass, timed without overlap.
    pub passes_ms: BTreeMap<String, f64>,
    pub frame_rates: Vec<FrameRate>,
    /// Results of the whole run, if it was executed.
    pub full: Option<FullRun>,
    /// Dry run before a whole run; none in older reports.
    #[serde(default)]
    pub dry_run: Option<DryRun>,
    /// Number of passes of each stage in an iteration; empty in older reports.
    #[serde(default)]
    pub passes_per_iteration: BTreeMap<String, f64>,
    /// Barriers of an iteration, after Gaussians of an iteration of the static field; none where there is no such iteration,
    /// and in older reports.
    #[serde(default)]
    pub barriers_per_iteration: Option<u32>,
    /// Minimum work of stages in an iteration; empty where Gaussians move, and in older reports.
    #[serde(default)]
    pub work: Ledger,
    /// Work that times of iterations do not include.
    #[serde(default)]
    pub left_out: String,
    /// Precision, shapes, tiles and workgroups.
    #[serde(default)]
    pub tuning: serde_json::Value,
    /// Machine in which the device is installed.
    #[serde(default)]
    pub host: Host,
}

/// Machine in which the device is installed.
#[derive(Default, Serialize, Deserialize)]
pub struct Host {
    /// Name of its processor, where the system reports it.
    pub processor: Option<String>,
    /// Number of threads it runs at once.
    pub threads: Option<usize>,
    /// `linux`, `macos` or `windows`.
    pub system: String,
}

impl Host {
    /// Describes the machine that this program runs on.
    pub fn this() -> Host {
        let threads = std::thread::available_parallelism().ok().map(std::num::NonZero::get);
        Host { processor: host_processor(), threads, system: std::env::consts::OS.into() }
    }
}

/// Results of a whole run.
#[derive(Serialize, Deserialize)]
pub struct FullRun {
    /// Seconds of training, without validation.
    pub train_s: f64,
    /// Seconds of the whole run.
    pub elapsed_s: f64,
    /// Validations during the run: iterations, seconds of training, Dice of the dynamic field.
    pub curve: Vec<(u32, f64, Option<f64>)>,
    /// Dice of the dynamic field on all unseen images.
    pub dice: Option<f64>,
    /// PSNR on all unseen images, dB; none without unseen images.
    pub psnr: Option<f64>,
    /// Times of its stages up to the last iteration.
    #[serde(default)]
    pub stages: Vec<StageTime>,
    /// Calls of the run to the device, without those of the scores; none in files of earlier versions.
    #[serde(default)]
    pub calls: Option<Calls>,
}

/// Tells whether a pass processes pairs of a Gaussian and a pixel, whose operations are counted.
fn is_over_pairs(pass: &str) -> bool {
    ["gaussian_splat", "gaussian_moments"].iter().any(|stage| pass.starts_with(stage))
}

/// Tells whether a pass belongs to the network whose operations are counted.
fn is_network(pass: &str) -> bool {
    pass.starts_with("mlp_layer") || pass.starts_with("mlp_out") || pass.starts_with("mlp_fused")
}

fn clock(seconds: f64) -> String {
    format!("{:02}:{:02}", seconds as u64 / 60, seconds as u64 % 60)
}

/// Prints a report.
pub fn print(report: &Report, kernels: bool) {
    out!("{} ({}), nertca-vk {} {}", report.device, report.driver, report.version, report.commit);
    let Host { processor, threads, system } = &report.host;
    let processor = processor.as_deref().unwrap_or("unknown processor");
    out!("host: {system}, {processor}, {} threads", threads.map_or("unknown".into(), |n| n.to_string()));
    report.paths.iter().for_each(|p| out!("- {p}"));
    let p = &report.peaks;
    let matrix = p.matrix_tflops.map_or("none".to_owned(), |t| format!("{t:.3} TFLOP/s"));
    let clock = if p.by_timestamps { "device" } else { "host" };
    out!(
        "peaks: f32 {:.3} TFLOP/s, f16 matrices {matrix}, copy {:.1} GB/s, measured with the {clock}'s clock",
        p.f32_tflops,
        p.copy_gb_per_s
    );
    match report.rays {
        // Methods that compare whole images have no rays.
        0 => out!("preset {}", report.preset),
        rays => out!("preset {}, {rays} rays per iteration", report.preset),
    }
    if let Some(gaussians) = &report.gaussians {
        print_gaussians(report, gaussians);
    }
    if let Some(before) = &report.before {
        let name = if report.gaussians.is_some() { "static field after them" } else { "before the network starts" };
        print_times(name, &before.ms, before.median(), before.host_cpu_share);
        print_conditions(before.iterations, Some(before.learned), before.readings.as_ref());
    }
    if let Some(after) = &report.after {
        print_network(report, after);
    }
    print_whole_run(report);
    if let Some(full) = &report.full {
        print_full(full);
    }
    print_frame_rates(&report.frame_rates);
    if kernels {
        print_passes(report);
    }
}

fn print_whole_run(report: &Report) {
    let (time, speedup) = (clock(report.whole_run_s), PAPER_SECONDS / report.whole_run_s);
    if report.of_the_paper {
        out!("whole run, extrapolated: {time}; the paper needs 37:00, so this is {speedup:.3} x as fast");
    } else {
        let min = if report.gaussians.as_ref().is_some_and(|timing| timing.grows) { "at least " } else { "" };
        out!(
            "whole run, extrapolated: {min}{time}; its iterations differ from the paper's, so a comparison with the \
             paper's 37:00 needs a Dice (--full)"
        );
    }
    if !report.left_out.is_empty() {
        out!("  not included: {}", report.left_out);
    }
}

fn print_full(full: &FullRun) {
    let number = |value: Option<f64>, digits: usize| value.map_or("-".into(), |v| format!("{v:.digits$}"));
    let speedup = PAPER_SECONDS / full.train_s;
    let compared = full.dice.map_or(String::new(), |_| format!(" ({speedup:.2} x as fast as 37:00)"));
    out!(
        "whole run, measured: {:.1} s of training{compared}, {:.1} s in total; Dice {}, PSNR {} dB",
        full.train_s,
        full.elapsed_s,
        number(full.dice, 3),
        number(full.psnr, 2)
    );
    for (step, seconds, dice) in &full.curve {
        out!("  {step:6} iterations {seconds:8.1} s: Dice {}", number(*dice, 3));
    }
}

/// Prints the passes in order of their time, with their share of an iteration, their minimum work, and the share of their time
/// that this work would take at the device's peaks.
fn print_passes(report: &Report) {
    let mut passes: Vec<_> = report.passes_ms.iter().collect();
    passes.sort_by(|a, b| b.1.total_cmp(a.1));
    let sum: f64 = report.passes_ms.values().sum();
    let [gflop, megabytes, of_limit] = ["GFLOP", "MB", "of limit"];
    out!("{:32} times        ms   share {gflop:>9} {megabytes:>9} {of_limit:>8}", "pass, executed separately");
    for (name, &ms) in passes {
        let times = report.passes_per_iteration.get(name).map_or("-".into(), |n| format!("{n:.0}"));
        let work = of_pass(&report.work, name).map_or(String::new(), |work| {
            let min = work.min_ms(peak_of(name, &report.peaks), report.peaks.copy_gb_per_s);
            format!(" {:9.3} {:9.2} {:6.0} %", work.gflop, work.megabytes, 100.0 * min / ms)
        });
        out!("{name:32} {times:>5} {ms:9.3} {:5.1} %{work}", 100.0 * ms / sum);
    }
    let count: f64 = report.passes_per_iteration.values().sum();
    let medians = [report.gaussians.as_ref().map(GaussianTiming::median), report.before.as_ref().map(Timing::median)];
    let iterations: f64 = match &report.after {
        Some(after) => after.median(),
        None => medians.into_iter().flatten().sum(),
    };
    out!("{:32} {count:5.0} {sum:9.3}   (iterations, with overlap: {iterations:.3} ms)", "all passes");
    if let Some(barriers) = report.barriers_per_iteration {
        out!("  {barriers} barriers between the passes of an iteration of the network or the static field");
    }
    let samples = report.after.as_ref().map_or(0, |after| after.live_samples);
    if let (Some(bytes), true) = (bytes_per_sample(report, samples), samples > 0) {
        out!("  {bytes:.0} bytes of memory per live sample, forward and backward");
    }
}

/// Returns the peak rate to compare a pass with, TFLOP/s.
fn peak_of(pass: &str, peaks: &Peaks) -> f64 {
    let on_matrices = pass.starts_with("mlp_fused");
    peaks.matrix_tflops.filter(|_| on_matrices).unwrap_or(peaks.f32_tflops)
}

/// Returns the bytes that the network's stages move per live sample.
fn bytes_per_sample(report: &Report, live_samples: u64) -> Option<f64> {
    let stages = report.work.iter().filter(|(stage, _)| is_network(stage) || *stage == "encode");
    let works: Vec<&StageWork> = stages.map(|(_, work)| work).collect();
    (!works.is_empty()).then(|| works.iter().map(|w| w.megabytes).sum::<f64>() * 1e6 / live_samples as f64)
}

/// Prints the conditions of the times: iterations of a repeat, iterations that the fields had learned, and the device's
/// sensors.
fn print_conditions(iterations: u32, learned: Option<u32>, readings: Option<&Readings>) {
    let learned = learned.map_or(String::new(), |n| format!(", after {n} iterations of training"));
    let span = |span: &Option<Span>, unit: &str| {
        span.map_or(String::new(), |s| format!("; {:.0} {unit} ({:.0} to {:.0})", s.mean, s.min, s.max))
    };
    let told = readings.map_or(String::new(), |r| {
        let quantities = [(&r.clock_mhz, "MHz"), (&r.power_w, "W"), (&r.temperature_c, "°C")];
        quantities.map(|(quantity, unit)| span(quantity, unit)).concat() + &format!(" by {}", r.source)
    });
    out!("  repeats of {iterations} iterations{learned}{told}");
}

/// Prints the times of an iteration on one line.
fn print_times(name: &str, ms: &[f64], median: f64, host_cpu_share: Option<f64>) {
    let (low, high) = ms.iter().fold((f64::INFINITY, 0f64), |(l, h), ms| (l.min(*ms), h.max(*ms)));
    let cpu = host_cpu_share.map_or(String::new(), |s| format!(", the process uses {s:.2} CPUs"));
    out!("{name:25}: {median:.3} ms per iteration (median of {}; {low:.3} to {high:.3}){cpu}", ms.len());
}

/// Returns the total milliseconds of the passes that `belongs` selects.
fn ms_of(report: &Report, belongs: impl Fn(&str) -> bool) -> f64 {
    report.passes_ms.iter().filter(|(name, _)| belongs(name)).map(|(_, ms)| ms).sum()
}

fn print_gaussians(report: &Report, gaussians: &GaussianTiming) {
    let GaussianTiming { form, count, work, .. } = gaussians;
    out!("{count} Gaussians, form {form}; their preparation takes {:.2} s", gaussians.preparation_s);
    let ms = gaussians.median();
    print_times("Gaussians", &gaussians.ms, ms, gaussians.host_cpu_share);
    print_conditions(gaussians.iterations, None, gaussians.readings.as_ref());
    out!(
        "  {} pairs of a Gaussian and a pixel: {:.3e} pairs/s, {:.4} TFLOP/s and {:.2} GB/s in whole iterations",
        work.pairs,
        work.pairs as f64 / ms * 1e3,
        work.gflop / ms,
        work.megabytes / ms
    );
    let pairs_ms = ms_of(report, is_over_pairs);
    if pairs_ms > 0.0 {
        let tflops = work.gflop / pairs_ms;
        let share = 100.0 * tflops / report.peaks.f32_tflops;
        out!("  passes over pairs only: {tflops:.4} TFLOP/s, {share:.0} % of the f32 peak");
    }
}

fn print_network(report: &Report, after: &Timing) {
    let ms = after.median();
    let samples_are_live = report.network_cost.is_some();
    let what = if samples_are_live { "with the network" } else { "iteration" };
    print_times(what, &after.ms, ms, after.host_cpu_share);
    print_conditions(after.iterations, Some(after.learned), after.readings.as_ref());
    if !samples_are_live {
        return;
    }
    let live = after.live_samples;
    out!(
        "  {live} live samples: {:.3e} samples/s, {:.4} TFLOP/s in whole iterations",
        live as f64 / ms * 1e3,
        after.network_gflop / ms
    );
    let network_ms = ms_of(report, is_network);
    if network_ms > 0.0 {
        let tflops = after.network_gflop / network_ms;
        let of = |peak: f64| 100.0 * tflops / peak;
        let matrices = report.peaks.matrix_tflops;
        let share = matrices.map_or(String::new(), |m| format!(", {:.0} % of the matrix peak", of(m)));
        out!("  network passes only: {tflops:.4} TFLOP/s, {:.0} % of the f32 peak{share}", of(report.peaks.f32_tflops));
    }
}

/// Prints the ratios of one report's results to another's.
pub fn compare(this: &Report, other: &Report) {
    out!("compared with {} on {} (ratios: this / other):", other.commit, other.device);
    if (&this.device, &this.driver) != (&other.device, &other.driver) {
        out!("  the other file is from another device or driver");
    }
    if this.config != other.config || this.rays != other.rays {
        out!("  the configurations differ: see both files");
    }
    let ratio = |name: &str, a: f64, b: f64| out!("  {name:32} {:6.3}  ({a:.3} / {b:.3})", a / b);
    if let (Some(a), Some(b)) = (&this.gaussians, &other.gaussians) {
        ratio("Gaussians, ms", a.median(), b.median());
        ratio("preparation of Gaussians, s", a.preparation_s, b.preparation_s);
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
