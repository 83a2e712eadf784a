//! Timing of training iterations.

use crate::config::Config;
use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::network::cost::NetworkCost;
use crate::plan::Plan;
use crate::scan::dataset::Dataset;
use crate::train::trainer::Trainer;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

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
