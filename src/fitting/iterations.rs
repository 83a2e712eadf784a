//! Recorded iterations of a fit with stages of its own, and the time of their passes.

use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::gpu::pace::{SubmitPace, longest_submit_s};
use crate::gpu::record::{Commands, PassTime, Recording};
use std::time::Instant;

/// Iterations of a fit, recorded once and submitted again and again.
pub(crate) struct Iterations {
    several: Commands,
    n_several: u32,
    single: Commands,
    pace: SubmitPace,
}

impl Iterations {
    /// Records a submit of `per_submit` iterations and a submit of one iteration. `make` records a given number of iterations.
    pub(crate) fn record(gpu: &Gpu, per_submit: u32, make: impl Fn(u32) -> Result<Commands>) -> Result<Iterations> {
        let pace = SubmitPace::new(longest_submit_s(gpu.info()), 1, per_submit).giving_way_to(gpu.looks());
        Ok(Iterations { several: make(per_submit)?, n_several: per_submit, single: make(1)?, pace })
    }

    /// Runs one submit of iterations, at most up to `stop`, and returns their number.
    pub(crate) fn run(&self, gpu: &Gpu, step: u32, stop: u32) -> Result<u32> {
        let several = stop - step >= self.n_several && self.pace.items() >= self.n_several;
        let (commands, n) = if several { (&self.several, self.n_several) } else { (&self.single, 1) };
        let begin = Instant::now();
        gpu.wait(commands.submit()?)?;
        self.pace.note(n, begin.elapsed().as_secs_f64());
        Ok(n)
    }
}

/// Runs a timed recording and returns the time of each of its passes.
pub(crate) fn pass_times(gpu: &Gpu, recording: Recording) -> Result<Vec<PassTime>> {
    let commands = recording.finish()?;
    gpu.wait(commands.submit()?)?;
    Ok(commands.pass_times()?)
}
