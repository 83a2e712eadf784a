//! `bench`: what an iteration costs, in all and pass by pass.

use super::args::{BenchArgs, Cli};
use nertca_vk::data::dataset::Dataset;
use nertca_vk::error::{Error, Result};
use nertca_vk::train::plan::Plan;
use nertca_vk::train::trainer::Trainer;
use serde::Serialize;
use std::collections::BTreeMap;
use std::time::Instant;

/// Iterations run before anything is timed.
const WARM_UP: u32 = 16;
/// Iterations timed pass by pass.
const PROFILED: u32 = 8;

#[derive(Serialize)]
struct Outcome {
    device: String,
    driver: String,
    paths: Vec<String>,
    preset: String,
    first_iteration: u32,
    live_samples: u64,
    /// Milliseconds per iteration of each repeat.
    ms_per_iteration: Vec<f64>,
    /// Milliseconds per iteration of each pass, by device timestamps, passes kept apart.
    passes_ms: BTreeMap<&'static str, f64>,
}

/// Times iterations of a configuration on a dataset.
pub fn run(cli: &Cli, args: &BenchArgs) -> Result<()> {
    // Iterations of a delayed dynamic field would time half the work.
    let config = args.config.load(["dynamic.delay=0".to_owned()])?;
    let dataset = Dataset::open(&args.data)?;
    let gpu = cli.open_device()?;
    let plan = Plan::new(&config, &dataset)?;
    let paths = plan.notes.clone();
    let mut trainer = Trainer::new(&gpu, plan, &dataset, cli.tuning(&gpu))?;
    let needed = WARM_UP + args.repeats * args.iterations + PROFILED;
    if needed > config.train.iterations {
        return Err(Error::config("--iterations", args.iterations, format!("{needed} iterations exceed the run's")));
    }
    let until = |trainer: &mut Trainer, n: u32| -> Result<u64> {
        let target = trainer.step() + n;
        let mut live = 0;
        while trainer.step() < target {
            live = trainer.advance(target)?.last().map_or(live, |l| l.live_samples);
        }
        Ok(live)
    };
    until(&mut trainer, WARM_UP)?;
    let mut outcome = Outcome {
        device: gpu.info().name.clone(),
        driver: gpu.info().driver.clone(),
        paths: paths.into_iter().chain(trainer.tuning().reasons.clone()).collect(),
        preset: format!("{:?}", config.preset),
        first_iteration: trainer.step(),
        live_samples: 0,
        ms_per_iteration: Vec::new(),
        passes_ms: BTreeMap::new(),
    };
    for _ in 0..args.repeats {
        let begin = Instant::now();
        outcome.live_samples = until(&mut trainer, args.iterations)?;
        outcome.ms_per_iteration.push(begin.elapsed().as_secs_f64() * 1e3 / f64::from(args.iterations));
    }
    for _ in 0..PROFILED {
        for pass in trainer.profile_step()? {
            *outcome.passes_ms.entry(pass.name).or_default() += pass.ms / f64::from(PROFILED);
        }
    }
    if args.json {
        out!("{}", serde_json::to_string_pretty(&outcome).map_err(|e| Error::Internal(e.to_string()))?);
    } else {
        print(&outcome);
    }
    drop(trainer);
    cli.close_device(&gpu)
}

fn print(outcome: &Outcome) {
    out!("{} ({}), preset {}", outcome.device, outcome.driver, outcome.preset);
    outcome.paths.iter().for_each(|p| out!("- {p}"));
    let mut sorted = outcome.ms_per_iteration.clone();
    sorted.sort_by(f64::total_cmp);
    out!(
        "{:.2} ms per iteration (median of {}; {:.2} to {:.2}), {} live samples",
        sorted[sorted.len() / 2],
        sorted.len(),
        sorted[0],
        sorted[sorted.len() - 1],
        outcome.live_samples
    );
    let mut passes: Vec<_> = outcome.passes_ms.iter().collect();
    passes.sort_by(|a, b| b.1.total_cmp(a.1));
    passes.iter().for_each(|(name, ms)| out!("{name:32} {ms:9.3} ms"));
}
