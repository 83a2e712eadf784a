//! Timing of training iterations.

use crate::choice::Choice;
use crate::config::Config;
use crate::error::{Error, Result};
use crate::fitting::fit::{FitData, FitStart, Measured, Start};
use crate::fitting::ledger::Ledger;
use crate::gaussians::work::GaussianWork;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::gpu::sensors::{Readings, Watch};
use crate::kernels::tuning::Tuning;
use crate::methods;
use crate::network::cost::NetworkCost;
use crate::plan::Plan;
use crate::scan::dataset::Dataset;
use crate::train::trainer::Trainer;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Duration of a measurement.
#[derive(Debug, Clone, Copy)]
pub struct Pace {
    /// Minimum time of iterations before any is timed, seconds: the clocks of a GPU take some to come to rest.
    pub warm_up_s: f64,
    /// Timed repeats.
    pub repeats: u32,
    /// Length of one repeat.
    pub length: Length,
}

/// Length of a timed repeat.
#[derive(Debug, Clone, Copy)]
pub enum Length {
    /// This many iterations; for Gaussians, at most this many of a fit's first ones.
    Iterations(u32),
    /// About this many seconds; for Gaussians, whole fits, as many as fill all repeats, and three at least.
    Seconds(f64),
}

/// Times of some iterations.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct Timing {
    /// Milliseconds per iteration of each repeat.
    pub ms: Vec<f64>,
    /// Live dynamic samples of an iteration, mean of those timed.
    pub live_samples: u64,
    /// Counted operations of an iteration's network, forward and backward, GFLOP.
    pub network_gflop: f64,
    /// Host CPU seconds per second of training, all threads of the process; a CPU driver's work is among them.
    pub host_cpu_share: Option<f64>,
    /// Iterations of each repeat; missing in older reports.
    #[serde(default)]
    pub iterations: u32,
    /// Iterations of training before the first repeat.
    #[serde(default)]
    pub learned: u32,
    /// Clock, power and temperature meanwhile, where the system reports them.
    #[serde(default)]
    pub readings: Option<Readings>,
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
    /// Form of the field: "phase" or "deformable set".
    pub form: String,
    /// Gaussians after the timed iterations.
    pub count: u32,
    /// Whether their number grows after the timed iterations; missing in older reports.
    #[serde(default)]
    pub grows: bool,
    /// Seconds from targets to the first iteration, median of the repeats: seeds, and of a deformable set the sets per phase and the
    /// tracking of its grid.
    pub preparation_s: f64,
    /// Milliseconds per iteration of each repeat, which is a fit of its own.
    pub ms: Vec<f64>,
    /// Host CPU seconds per second of the fit, all threads of the process; a CPU driver's work is among them.
    pub host_cpu_share: Option<f64>,
    /// Work of the last timed iteration.
    pub work: GaussianWork,
    /// Iterations of each repeat; missing in older reports.
    #[serde(default)]
    pub iterations: u32,
    /// Clock, power and temperature meanwhile, where the system reports them.
    #[serde(default)]
    pub readings: Option<Readings>,
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

/// CPU time this process has used, where the system reports it (Linux).
fn cpu_time() -> Option<Duration> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // Fields after the command, which may hold blanks and ends at the last parenthesis: 12 and 13 are ticks of 10 ms.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks: u64 = fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?;
    Some(Duration::from_millis(10 * ticks))
}

/// State of the host and the device at the beginning of a measurement.
struct Measurement {
    cpu: Option<Duration>,
    begin: Instant,
    watch: Option<Watch>,
}

impl Measurement {
    fn begin(gpu: &Gpu) -> Measurement {
        Measurement { cpu: cpu_time(), begin: Instant::now(), watch: Watch::begin(gpu.info()) }
    }

    /// Returns CPU seconds per second, and the readings of the device's sensors.
    fn end(self) -> (Option<f64>, Option<Readings>) {
        let share =
            |(before, after): (Duration, Duration)| (after - before).as_secs_f64() / self.begin.elapsed().as_secs_f64();
        (self.cpu.zip(cpu_time()).map(share), self.watch.and_then(Watch::end))
    }
}

/// Passes of an iteration by their stages' names.
pub type Passes = BTreeMap<String, PassMean>;

/// All passes of a stage in an iteration.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PassMean {
    /// Number of them.
    pub count: f64,
    /// Milliseconds of all of them, each timed apart from the others.
    pub ms: f64,
}

/// Adds the passes of an iteration to means over `iterations`.
fn add_passes(means: &mut Passes, passes: Vec<PassTime>, iterations: u32) {
    for pass in passes {
        let mean = means.entry(pass.name.to_owned()).or_default();
        mean.count += 1.0 / f64::from(iterations);
        mean.ms += pass.ms / f64::from(iterations);
    }
}

/// A run to time. It learns slowly, so that operands are those of a field that has learned something and a schedule's high
/// rates cannot make it diverge; all bands of the encoding are open.
pub struct Subject {
    gpu: Gpu,
    trainer: Trainer,
    cost: NetworkCost,
    n_rays: u32,
    /// Iterations that there is a schedule for.
    max: u32,
}

/// Learning rate of a timed run, as a share of the last rates of its configuration.
const SLOWLY: f64 = 0.1;
/// Maximum number of iterations that a schedule is made for; nothing is timed longer.
const MAX_ITERATIONS: u32 = 300_000;
/// Minimum number of iterations before anything is timed: a CPU's driver compiles in the first.
const WARM_UP: u32 = 4;

impl Subject {
    /// Prepares a run of a configuration, with the network on or off throughout; where Gaussians move, it is off, and the
    /// run is that of the static field after them.
    ///
    /// # Errors
    /// Errors of the configuration, the data and the device.
    pub fn new(gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning, with_network: bool) -> Result<Subject> {
        let mut config = config.clone();
        let method = methods::of(&config);
        let max = MAX_ITERATIONS.min(u32::MAX / (method.rays_per_iteration)(&config).max(1));
        config.train.iterations = max;
        (method.lower_rates)(&mut config, SLOWLY);
        config.delay_network(if with_network { 0 } else { max });
        let plan = Plan::new(&config, dataset)?;
        let (cost, n_rays) = (NetworkCost::of(&plan.params), (method.rays_per_iteration)(&config));
        let trainer = Trainer::new(gpu, plan, dataset, tuning.clone())?;
        let mut subject = Subject { gpu: gpu.clone(), trainer, cost, n_rays, max };
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

    /// Barriers of an iteration; none where a Lineformer is all there is.
    pub fn barriers(&mut self) -> Option<u32> {
        self.trainer.measured()?.barriers()
    }

    /// Operations of the network per sample.
    pub fn cost(&self) -> NetworkCost {
        self.cost
    }

    /// Minimum work of an iteration's stages with `live_samples` live samples.
    pub fn work(&mut self, live_samples: u64) -> Ledger {
        self.trainer.measured().map_or_else(Ledger::new, |fit| fit.ledger(live_samples))
    }

    /// Runs `n` iterations; returns the live samples of all of them.
    fn run(&mut self, n: u32) -> Result<u64> {
        let target = self.trainer.step() + n;
        let mut live = 0;
        while self.trainer.step() < target {
            live += self.trainer.advance(target)?.iter().map(|l| l.live_samples).sum::<u64>();
        }
        Ok(live)
    }

    /// Warms up, and times repeats.
    ///
    /// # Errors
    /// [`Error::Diverged`]; device errors.
    pub fn time(&mut self, pace: &Pace) -> Result<Timing> {
        let ms_before = self.warm_up(pace.warm_up_s)?;
        let left = self.max.saturating_sub(self.trainer.step()) / 2 / pace.repeats;
        let iterations = match pace.length {
            Length::Iterations(n) => n,
            Length::Seconds(seconds) => ((1e3 * seconds / ms_before).ceil() as u32).clamp(1, left.max(1)),
        };
        let (learned, mut live_samples, mut ms) = (self.trainer.step(), 0, Vec::new());
        let meanwhile = Measurement::begin(&self.gpu);
        for _ in 0..pace.repeats {
            let begin = Instant::now();
            live_samples += self.run(iterations)?;
            ms.push(begin.elapsed().as_secs_f64() * 1e3 / f64::from(iterations));
        }
        let (host_cpu_share, readings) = meanwhile.end();
        let live_samples = live_samples / u64::from(iterations * pace.repeats);
        let network_gflop = live_samples as f64 * self.cost.total() as f64 * 1e-9;
        Ok(Timing { ms, live_samples, network_gflop, host_cpu_share, iterations, learned, readings })
    }

    /// Runs for this many seconds, an iteration at least; returns the milliseconds of one.
    fn warm_up(&mut self, seconds: f64) -> Result<f64> {
        let (begin, mut done) = (Instant::now(), 0);
        while done == 0 || (begin.elapsed().as_secs_f64() < seconds && self.trainer.step() < self.max / 2) {
            // As many as the time so far makes a tenth of the whole, so that submits stay full.
            let rate = f64::from(done) / begin.elapsed().as_secs_f64().max(1e-9);
            let n = ((0.1 * seconds * rate) as u32).clamp(1, (self.max / 20).max(1));
            self.run(n)?;
            done += n;
        }
        Ok(begin.elapsed().as_secs_f64() * 1e3 / f64::from(done))
    }

    /// Milliseconds of each pass, kept apart, averaged over `iterations`.
    ///
    /// # Errors
    /// Device errors.
    pub fn passes(&mut self, iterations: u32) -> Result<Passes> {
        let mut passes = Passes::new();
        for _ in 0..iterations {
            add_passes(&mut passes, self.trainer.profile_step()?, iterations);
        }
        Ok(passes)
    }
}

/// Fits of Gaussians to time: real ones from their seeds on, as their work depends on how large Gaussians become.
pub struct GaussianSubject {
    gpu: Gpu,
    data: Box<dyn FitData>,
    config: Config,
    /// Iterations of a fit that are timed.
    timed: u32,
    notes: Vec<String>,
}

/// Maximum number of timed iterations of a fit of Gaussians: some have thousands before their Gaussians become more.
const MAX_TIMED: u32 = 200;

/// Minimum number of fits: one says nothing of how they differ.
const MIN_FITS: usize = 3;

/// A fit that was timed.
struct TimedGaussians {
    fit: Box<dyn Measured>,
    preparation_s: f64,
    /// Milliseconds per iteration.
    ms: f64,
}

impl GaussianSubject {
    /// Prepares fits of a configuration whose dynamic field is made of Gaussians, of which `profiled` more iterations may be
    /// timed pass by pass.
    ///
    /// # Errors
    /// Errors of the configuration and the data.
    pub fn new(
        gpu: &Gpu,
        config: &Config,
        dataset: &Dataset,
        length: Length,
        profiled: u32,
    ) -> Result<GaussianSubject> {
        let mut config = config.clone();
        let of_fit = config.gaussian_iterations().min(MAX_TIMED);
        let timed = match length {
            Length::Iterations(n) => n,
            Length::Seconds(_) => of_fit.saturating_sub(WARM_UP).max(1),
        };
        let min = WARM_UP + timed;
        if let Some(iterations) = config.gaussian_iterations_mut() {
            *iterations = (*iterations).max(min) + profiled;
        }
        let mut plan = Plan::new(&config, dataset)?;
        let data = plan.data.take().ok_or_else(|| Error::Internal("the plan has no data".into()))?;
        Ok(GaussianSubject { gpu: gpu.clone(), data, config, timed, notes: plan.notes })
    }

    fn begin(&self) -> Result<Box<dyn Measured>> {
        let tuning = Tuning::for_device(self.gpu.info());
        let (gpu, config) = (&self.gpu, &self.config);
        match methods::of(config).abilities.time_gaussians {
            Some(begin) => begin(&*self.data, &FitStart { gpu, config, tuning: &tuning, from: Start::default() }),
            None => Err(without_gaussians(config)),
        }
    }

    /// Choices about data and settings.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    fn fit(&self) -> Result<TimedGaussians> {
        let begin = Instant::now();
        let mut fit = self.begin()?;
        while fit.progress().preparation.is_some() {
            fit.advance(0)?;
        }
        let preparation_s = begin.elapsed().as_secs_f64();
        run_fit(fit.as_mut(), WARM_UP)?;
        let begin = Instant::now();
        run_fit(fit.as_mut(), WARM_UP + self.timed)?;
        let ms = begin.elapsed().as_secs_f64() * 1e3 / f64::from(self.timed);
        Ok(TimedGaussians { fit, preparation_s, ms })
    }

    /// Warms up by whole fits, times others, and says what the passes of an iteration after the last of them take.
    ///
    /// # Errors
    /// [`Error::Config`] for a method without Gaussians; device errors.
    pub fn time(&self, pace: &Pace, profiled: u32) -> Result<(GaussianTiming, Passes)> {
        let begin = Instant::now();
        while begin.elapsed().as_secs_f64() < pace.warm_up_s {
            self.fit()?;
        }
        let (begin, meanwhile) = (Instant::now(), Measurement::begin(&self.gpu));
        let mut last = self.fit()?;
        let (mut ms, mut preparation_s) = (vec![last.ms], vec![last.preparation_s]);
        let more = |done: usize| match pace.length {
            Length::Iterations(_) => done < pace.repeats as usize,
            Length::Seconds(seconds) => {
                done < MIN_FITS || begin.elapsed().as_secs_f64() < seconds * f64::from(pace.repeats)
            }
        };
        while more(ms.len()) {
            last = self.fit()?;
            ms.push(last.ms);
            preparation_s.push(last.preparation_s);
        }
        let (host_cpu_share, readings) = meanwhile.end();
        let work = last.fit.work()?.ok_or_else(|| without_gaussians(&self.config))?;
        let timing = GaussianTiming {
            form: work.form.unwrap_or_else(|| self.config.method_name()).into(),
            count: work.count,
            grows: self.config.fields().is_none(),
            preparation_s: median(&preparation_s),
            ms,
            host_cpu_share,
            work: work.work,
            iterations: self.timed,
            readings,
        };
        let mut passes = Passes::new();
        for _ in 0..profiled {
            add_passes(&mut passes, last.fit.profile_step()?, profiled);
        }
        Ok((timing, passes))
    }
}

fn without_gaussians(config: &Config) -> Error {
    Error::config("preset", config.preset.name(), "has no Gaussians to time")
}

/// Runs a fit up to an iteration.
fn run_fit(fit: &mut dyn Measured, until: u32) -> Result<()> {
    while fit.progress().step < until {
        if fit.advance(until)?.losses.is_empty() {
            return Err(Error::Internal("the timed fit is over".into()));
        }
    }
    Ok(())
}
