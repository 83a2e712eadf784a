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

/// Course of a dry run.
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

/// Runs through all events of a configuration's schedule.
///
/// # Errors
/// [`crate::error::Error::Diverged`] when a loss or a parameter is not finite; errors of the configuration, the data and the
/// device.
pub fn dry_run(gpu: &Gpu, config: &Config, dataset: &Dataset, tuning: &Tuning) -> Result<DryRun> {
    let short = config.of_dry_run();
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
