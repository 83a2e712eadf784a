//! Measurements: iterations before and after the network starts, passes, what the device can do at most, and the whole
//! run against the paper's 37 minutes.

use crate::config::Config;
use crate::data::dataset::Dataset;
use crate::error::Result;
use crate::gpu::capabilities::MatrixShape;
use crate::gpu::device::Gpu;
use crate::gpu::memory::{Buffer, Memory};
use crate::gpu::pipeline::Pipeline;
use crate::gpu::record::{Bound, Groups, Recording};
use crate::kernels::{Tuning, kernel_code};
use crate::model::params::ParamLayout;
use crate::train::plan::Plan;
use crate::train::trainer::Trainer;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Seconds the paper needs for a reconstruction on an RTX A5000 (section 4: 37 minutes).
pub const PAPER_SECONDS: f64 = 37.0 * 60.0;

/// What the device reaches in micro-benchmarks that do nothing else.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Peaks {
    /// f32 multiply-adds, TFLOP/s.
    pub f32_tflops: f64,
    /// Products of f16 matrices with f32 sums, TFLOP/s; none without cooperative matrices.
    pub matrix_tflops: Option<f64>,
    /// Bytes read and written by a large copy, GB/s.
    pub copy_gb_per_s: f64,
}

/// Times of some iterations.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Timing {
    /// Milliseconds per iteration of each repeat.
    pub ms: Vec<f64>,
    /// Live dynamic samples of the last iteration.
    pub live_samples: u64,
    /// Counted operations of an iteration's network, forward and backward, GFLOP.
    pub network_gflop: f64,
    /// Host CPU seconds per second of training, all threads of the process; a CPU driver's work is among them.
    pub host_cpu_share: Option<f64>,
}

impl Timing {
    /// Median of the repeats.
    pub fn median(&self) -> f64 {
        let mut sorted = self.ms.clone();
        sorted.sort_by(f64::total_cmp);
        sorted[sorted.len() / 2]
    }
}

/// Operations of the network per sample, a multiply-add counted as two.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
pub struct NetworkCost {
    /// Forward.
    pub forward: u64,
    /// Gradient of the weights.
    pub weights: u64,
    /// Gradient of hidden inputs.
    pub inputs: u64,
}

impl NetworkCost {
    /// Counts, without padding and without biases and latents, which cost one row per phase.
    pub fn of(params: &ParamLayout) -> NetworkCost {
        let width = params.width as u64;
        let mut forward = width;
        let mut inputs = width;
        for layer in &params.layers {
            forward += layer.encoded.map_or(0, |_| width * params.encoded_len as u64);
            forward += layer.hidden.map_or(0, |_| width * width);
            inputs += layer.hidden.map_or(0, |_| width * width);
        }
        NetworkCost { forward: 2 * forward, weights: 2 * forward, inputs: 2 * inputs }
    }

    /// All three.
    pub fn total(&self) -> u64 {
        self.forward + self.weights + self.inputs
    }
}

/// CPU time this process has used, where the system tells (Linux).
fn cpu_time() -> Option<Duration> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // Fields after the command, which may hold blanks and ends at the last parenthesis: 12 and 13 are ticks of 10 ms.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks: u64 = fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?;
    Some(Duration::from_millis(10 * ticks))
}

/// A run to time: nothing is learned, so that a schedule's high learning rates cannot make it diverge; work does not
/// depend on the parameters' values.
pub struct Subject {
    trainer: Trainer,
    cost: NetworkCost,
    n_rays: u32,
}

/// Iterations before anything is timed.
const WARM_UP: u32 = 4;

impl Subject {
    /// Prepares a run of a configuration, with the network on or off throughout.
    ///
    /// # Errors
    /// Errors of the configuration, the data and the device.
    pub fn new(gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning, with_network: bool) -> Result<Subject> {
        let mut config = config.clone();
        config.train.iterations = config.train.iterations.max(30_000);
        for rate in [
            &mut config.dynamic.lr,
            &mut config.dynamic.lr_end,
            &mut config.static_field.lr,
            &mut config.static_field.lr_end,
        ] {
            *rate = 0.0;
        }
        config.dynamic.delay = if with_network { 0 } else { config.train.iterations };
        let plan = Plan::new(&config, dataset)?;
        let (cost, n_rays) = (NetworkCost::of(&plan.params), plan.setup.n_rays);
        let mut subject = Subject { trainer: Trainer::new(gpu, plan, dataset, tuning.clone())?, cost, n_rays };
        subject.run(WARM_UP)?;
        Ok(subject)
    }

    /// Choices about data and device.
    pub fn notes(&self) -> Vec<String> {
        self.trainer.plan().notes.iter().chain(&self.trainer.tuning().reasons).cloned().collect()
    }

    /// Rays of an iteration.
    pub fn rays(&self) -> u32 {
        self.n_rays
    }

    /// Operations of the network per sample.
    pub fn cost(&self) -> NetworkCost {
        self.cost
    }

    fn run(&mut self, n: u32) -> Result<u64> {
        let target = self.trainer.step() + n;
        let mut live = 0;
        while self.trainer.step() < target {
            live = self.trainer.advance(target)?.last().map_or(live, |l| l.live_samples);
        }
        Ok(live)
    }

    /// Times `repeats` times `iterations` iterations.
    ///
    /// # Errors
    /// Device errors.
    pub fn time(&mut self, iterations: u32, repeats: u32) -> Result<Timing> {
        let mut timing = Timing { ms: Vec::new(), live_samples: 0, network_gflop: 0.0, host_cpu_share: None };
        let (cpu, all) = (cpu_time(), Instant::now());
        for _ in 0..repeats {
            let begin = Instant::now();
            timing.live_samples = self.run(iterations)?;
            timing.ms.push(begin.elapsed().as_secs_f64() * 1e3 / f64::from(iterations));
        }
        timing.host_cpu_share =
            cpu.zip(cpu_time()).map(|(before, after)| (after - before).as_secs_f64() / all.elapsed().as_secs_f64());
        timing.network_gflop = timing.live_samples as f64 * self.cost.total() as f64 * 1e-9;
        Ok(timing)
    }

    /// Milliseconds of each pass, kept apart, averaged over `iterations`.
    ///
    /// # Errors
    /// Device errors.
    pub fn passes(&mut self, iterations: u32) -> Result<BTreeMap<String, f64>> {
        let mut passes = BTreeMap::new();
        for _ in 0..iterations {
            for pass in self.trainer.profile_step()? {
                *passes.entry(pass.name.to_owned()).or_default() += pass.ms / f64::from(iterations);
            }
        }
        Ok(passes)
    }
}

/// Runs a dispatch eight times and returns the shortest time, of the submit and the wait for it.
fn best_seconds(
    gpu: &Gpu,
    stage: &Arc<Pipeline>,
    groups: [u32; 3],
    buffers: &[(&str, &Buffer)],
    push: &impl bytemuck::Pod,
) -> Result<f64> {
    let bound: Vec<_> = buffers.iter().map(|(name, b)| (*name, Bound::Buffer(b))).collect();
    let mut recording = Recording::new(gpu, "peak")?;
    recording.dispatch(stage, Groups::Direct(groups), &bound, push)?;
    let commands = recording.finish()?;
    let mut best = f64::INFINITY;
    for _ in 0..8 {
        let begin = Instant::now();
        gpu.wait(commands.submit()?)?;
        best = best.min(begin.elapsed().as_secs_f64());
    }
    Ok(best)
}

/// Measures what the device can do at most.
///
/// # Errors
/// Device errors.
pub fn peaks(gpu: &Gpu) -> Result<Peaks> {
    let info = gpu.info();
    let is_cpu = info.kind == "cpu";
    // Some milliseconds on either kind of device.
    let (lanes, steps): (u32, u32) = if is_cpu { (256, 8000) } else { (1 << 19, 1024) };
    let stage = Arc::new(gpu.pipeline(kernel_code("peak_f32")?, 64, &[])?);
    let sink = gpu.buffer("sink", u64::from(lanes) * 16, Memory::Device)?;
    #[repr(C)]
    #[derive(Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
    struct F32Push {
        steps: u32,
        a: f32,
        b: f32,
    }
    let push = F32Push { steps, a: 0.999, b: 0.001 };
    let seconds = best_seconds(gpu, &stage, [lanes / 64, 1, 1], &[("sink", &sink)], &push)?;
    let f32_tflops = f64::from(lanes) * f64::from(steps) * 32.0 * 12.0 * 2.0 / seconds * 1e-12;

    let matrix_tflops = match info.matrices.first() {
        Some(shape) => Some(matrix_peak(gpu, *shape)?),
        None => None,
    };

    let bytes = u64::from(info.max_storage_buffer_range).min(if is_cpu { 64 << 20 } else { 1 << 30 }) / 4096 * 4096;
    let stage = Arc::new(gpu.pipeline(kernel_code("peak_copy")?, 64, &[])?);
    let (from, to) = (gpu.buffer("from", bytes, Memory::Device)?, gpu.buffer("to", bytes, Memory::Device)?);
    let count = (bytes / 16) as u32;
    let per_row = 16_384;
    let groups = [per_row, count.div_ceil(64 * per_row), 1];
    let seconds = best_seconds(gpu, &stage, groups, &[("from", &from), ("to", &to)], &count)?;
    Ok(Peaks { f32_tflops, matrix_tflops, copy_gb_per_s: 2.0 * bytes as f64 / seconds * 1e-9 })
}

fn matrix_peak(gpu: &Gpu, MatrixShape { m, n, k }: MatrixShape) -> Result<f64> {
    let info = gpu.info();
    let subgroups = 8;
    let (groups, steps): (u32, u32) = if info.kind == "cpu" { (4, 2000) } else { (4096, 2048) };
    let spec = [("m", m), ("n", n), ("k", k), ("subgroups", subgroups)];
    let code = kernel_code("peak_matrix")?;
    let stage = Arc::new(gpu.matrix_pipeline(code, subgroups * info.subgroup_size, &spec)?);
    let random: Vec<half::f16> = (0..2 * (m * k).max(k * n))
        .map(|i| half::f16::from_f64(crate::cpu::random::uniform01(1, 0, i, 0) - 0.5))
        .collect();
    let operands = gpu.buffer_with("operands16", &random)?;
    let sink = gpu.buffer("sink", u64::from(groups * subgroups * m * n) * 4, Memory::Device)?;
    let buffers = [("operands16", &operands), ("sink", &sink)];
    let seconds = best_seconds(gpu, &stage, [groups, 1, 1], &buffers, &steps)?;
    Ok(f64::from(groups * subgroups) * f64::from(steps) * 4.0 * f64::from(2 * m * n * k) / seconds * 1e-12)
}
