//! A short run through all events of a configuration's schedule at its real sizes, before hours are spent on the whole one.

use crate::config::Config;
use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::plan::Plan;
use crate::scan::dataset::Dataset;
use crate::train::trainer::Trainer;
use serde::{Deserialize, Serialize};
use std::time::Instant;

/// Iterations of a dry run: enough for every event of the presets to have iterations before and after it.
const ITERATIONS: u32 = 20;
/// Iterations of a dry run with density control, which comes every ten iterations at most.
const ITERATIONS_WITH_DENSIFYING: u32 = 60;
/// Iterations after the last event, at least.
const AFTER_THE_LAST: u32 = 4;

/// What a dry run went through.
#[derive(Debug, Clone, Serialize, Deserialize)]
pub struct DryRun {
    /// Iterations done.
    pub iterations: u32,
    /// Iterations, counted from 0, at which the schedule changed something.
    pub events: Vec<u32>,
    /// Seconds of the iterations.
    pub seconds: f64,
    /// Objective of the last iteration.
    pub last_loss: f64,
}

/// Returns the configuration of a dry run: its schedule keeps its order, and its batches their sizes.
///
/// # Errors
/// [`crate::error::Error::Config`] when so short a run is refused.
pub fn shortened(config: &Config) -> Result<Config> {
    let iterations = if config.has_gaussians_alone() { ITERATIONS_WITH_DENSIFYING } else { ITERATIONS };
    if config.train.iterations <= iterations {
        return Ok(config.clone());
    }
    let mut short = config.of_length(iterations)?;
    if short.follows_breath() {
        // A fit of Gaussians has a length of its own, of which nothing is a share of the run.
        short.train.iterations = short.gaussians.iterations.saturating_add(iterations).min(config.train.iterations);
    }
    if short.is_sax() {
        // Its only event lies within the last iterations of the publication.
        short.sax.rate_falls_at = short.sax.rate_falls_at.min(iterations / 2);
    }
    let last = short.schedule_events().last().copied().unwrap_or(0);
    short.train.iterations = short.train.iterations.max(last.saturating_add(AFTER_THE_LAST));
    Ok(short)
}

/// Runs through all events of a configuration's schedule.
///
/// # Errors
/// [`crate::error::Error::Diverged`] when a loss or a parameter is not finite; errors of the configuration, the data and the device.
pub fn dry_run(gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning) -> Result<DryRun> {
    let short = shortened(config)?;
    let iterations = short.train.iterations;
    let mut trainer = Trainer::new(gpu, Plan::new(&short, dataset)?, dataset, tuning.clone())?;
    let (begin, mut last_loss) = (Instant::now(), f64::NAN);
    while trainer.step() < iterations {
        if let Some(loss) = trainer.advance(iterations)?.last() {
            last_loss = loss.total();
        }
    }
    // Refuses parameters that are not finite.
    trainer.checkpoint()?;
    Ok(DryRun { iterations, events: short.schedule_events(), seconds: begin.elapsed().as_secs_f64(), last_loss })
}
