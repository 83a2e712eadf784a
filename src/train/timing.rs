//! Timing of training iterations.

use crate::choice::Choice;
use crate::config::Config;
use crate::config::sections::Tree;
use crate::error::{Error, Result};
use crate::gaussians::work::GaussianWork;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::kernels::tuning::Tuning;
use crate::network::cost::NetworkCost;
use crate::plan::Plan;
use crate::scan::dataset::Dataset;
use crate::train::moving::MovingFit;
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
        median(&self.ms)
    }
}

/// Times and work of a fit of Gaussians.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct GaussianTiming {
    /// Form of the field: "phase" or "tree".
    pub form: String,
    /// Gaussians after the timed iterations.
    pub count: u32,
    /// Seconds from targets to the first iteration: seeds, and of a tree the sets per phase and the tracking of its grid.
    pub preparation_s: f64,
    /// Milliseconds per iteration of each repeat; the fit goes on from one to the next.
    pub ms: Vec<f64>,
    /// Host CPU seconds per second of the fit, all threads of the process; a CPU driver's work is among them.
    pub host_cpu_share: Option<f64>,
    /// Work of the last timed iteration.
    pub work: GaussianWork,
}

impl GaussianTiming {
    /// Median of the repeats.
    pub fn median(&self) -> f64 {
        median(&self.ms)
    }
}

fn median(ms: &[f64]) -> f64 {
    let mut sorted = ms.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[sorted.len() / 2]
}

/// CPU time this process has used, where the system tells (Linux).
fn cpu_time() -> Option<Duration> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // Fields after the command, which may hold blanks and ends at the last parenthesis: 12 and 13 are ticks of 10 ms.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks: u64 = fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?;
    Some(Duration::from_millis(10 * ticks))
}

/// Milliseconds per iteration of `repeats` times `iterations` iterations that `run` runs, and CPU seconds per second.
fn time_repeats(iterations: u32, repeats: u32, mut run: impl FnMut() -> Result<()>) -> Result<(Vec<f64>, Option<f64>)> {
    let (cpu, all, mut ms) = (cpu_time(), Instant::now(), Vec::new());
    for _ in 0..repeats {
        let begin = Instant::now();
        run()?;
        ms.push(begin.elapsed().as_secs_f64() * 1e3 / f64::from(iterations));
    }
    let share = cpu.zip(cpu_time()).map(|(before, after)| (after - before).as_secs_f64() / all.elapsed().as_secs_f64());
    Ok((ms, share))
}

/// Adds the passes of an iteration to means over `iterations`.
fn add_passes(means: &mut BTreeMap<String, f64>, passes: Vec<PassTime>, iterations: u32) {
    for pass in passes {
        *means.entry(pass.name.to_owned()).or_default() += pass.ms / f64::from(iterations);
    }
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
    /// Prepares a run of a configuration, with the network on or off throughout; where Gaussians move, it is off, and the
    /// run is that of the still field after them.
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
        // As few Gaussians' iterations as can be, which leave the still field the same work.
        config.gaussians.iterations = 1;
        config.tree = Tree { warm_iterations: 1, take: 0.0, track_iterations: 0, ..config.tree };
        config.dynamic.delay = if with_network { 0 } else { config.train.iterations };
        let plan = Plan::new(&config, dataset)?;
        let (cost, n_rays) = (NetworkCost::of(&plan.params), plan.setup.n_rays);
        let mut subject = Subject { trainer: Trainer::new(gpu, plan, dataset, tuning.clone())?, cost, n_rays };
        subject.run(config.gaussian_iterations() + WARM_UP)?;
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
        let mut live_samples = 0;
        let (ms, host_cpu_share) = time_repeats(iterations, repeats, || {
            live_samples = self.run(iterations)?;
            Ok(())
        })?;
        let network_gflop = live_samples as f64 * self.cost.total() as f64 * 1e-9;
        Ok(Timing { ms, live_samples, network_gflop, host_cpu_share })
    }

    /// Milliseconds of each pass, kept apart, averaged over `iterations`.
    ///
    /// # Errors
    /// Device errors.
    pub fn passes(&mut self, iterations: u32) -> Result<BTreeMap<String, f64>> {
        let mut passes = BTreeMap::new();
        for _ in 0..iterations {
            add_passes(&mut passes, self.trainer.profile_step()?, iterations);
        }
        Ok(passes)
    }
}

/// A fit of Gaussians to time. It is a real one from its seeds on: its work depends on how large Gaussians become.
pub struct GaussianSubject {
    fit: MovingFit,
    preparation_s: f64,
    notes: Vec<String>,
}

impl GaussianSubject {
    /// Prepares the fit of a configuration whose moving field is made of Gaussians, with `most` iterations to time and to
    /// profile, or as many as the configuration has if these are more.
    ///
    /// # Errors
    /// [`Error::Config`] where the network moves; errors of the configuration, the data and the device.
    pub fn new(gpu: &Gpu, config: &Config, dataset: &Dataset, most: u32) -> Result<GaussianSubject> {
        let mut config = config.clone();
        config.gaussians.iterations = config.gaussians.iterations.max(most + WARM_UP);
        if config.is_r2() {
            config.train.iterations = config.train.iterations.max(most + WARM_UP);
        }
        let mut plan = Plan::new(&config, dataset)?;
        let begin = Instant::now();
        let Some(fit) = MovingFit::begin(gpu, &mut plan, &config)? else {
            return Err(Error::config(
                "gaussians.form",
                config.gaussians.form.name(),
                "there are no Gaussians to time",
            ));
        };
        let mut subject = GaussianSubject { fit, preparation_s: 0.0, notes: plan.notes };
        while subject.fit.preparation().is_some() {
            subject.fit.advance(0)?;
        }
        subject.preparation_s = begin.elapsed().as_secs_f64();
        subject.run(WARM_UP)?;
        Ok(subject)
    }

    /// Choices about data and settings.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    fn run(&mut self, n: u32) -> Result<()> {
        let target = self.fit.step() + n;
        while self.fit.step() < target {
            if self.fit.advance(target)?.is_empty() {
                return Err(Error::Internal("the timed fit is over".into()));
            }
        }
        Ok(())
    }

    /// Times `repeats` times `iterations` iterations.
    ///
    /// # Errors
    /// [`Error::Internal`] beyond the iterations prepared for; device errors.
    pub fn time(&mut self, iterations: u32, repeats: u32) -> Result<GaussianTiming> {
        let (ms, host_cpu_share) = time_repeats(iterations, repeats, || self.run(iterations))?;
        Ok(GaussianTiming {
            form: self.fit.form().name().into(),
            count: self.fit.count(),
            preparation_s: self.preparation_s,
            ms,
            host_cpu_share,
            work: self.fit.work()?,
        })
    }

    /// Milliseconds of each pass, kept apart, averaged over `iterations`.
    ///
    /// # Errors
    /// Device errors.
    pub fn passes(&mut self, iterations: u32) -> Result<BTreeMap<String, f64>> {
        let mut passes = BTreeMap::new();
        for _ in 0..iterations {
            add_passes(&mut passes, self.fit.profile_step()?, iterations);
        }
        Ok(passes)
    }
}
