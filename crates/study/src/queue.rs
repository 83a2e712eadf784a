//! Queue of a study: runs one after the other.

use crate::events::StudyEvent;
use crate::outcome::Outcome;
use crate::plan::{Run, Study};
use crate::work::{Observe, Workplace};
use nertca_vk::error::{Error, Result};

/// Summary of a queue.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Summary {
    /// Runs of the study.
    pub runs: usize,
    /// Runs that have a result.
    pub done: usize,
    /// Runs with a result that failed.
    pub failed: usize,
}

/// Durations of runs in seconds, by method.
struct Times {
    of_methods: Vec<Vec<f64>>,
}

impl Times {
    fn new(study: &Study) -> Times {
        Times { of_methods: vec![Vec::new(); study.methods.len()] }
    }

    fn note(&mut self, run: &Run, outcome: &Outcome) {
        self.of_methods[run.method].push(outcome.seconds.whole);
    }

    /// Estimated total duration of the runs to come, from the mean of their method or else of all methods; none before any run
    /// was timed.
    fn left_s(&self, runs: &[&Run]) -> Option<f64> {
        let mean = |values: &mut dyn Iterator<Item = f64>| {
            let (n, sum) = values.fold((0, 0.0), |(n, sum), value| (n + 1, sum + value));
            (n > 0).then(|| sum / f64::from(n))
        };
        let of_all = mean(&mut self.of_methods.iter().flatten().copied())?;
        let of_run = |run: &&Run| mean(&mut self.of_methods[run.method].iter().copied()).unwrap_or(of_all);
        Some(runs.iter().map(of_run).sum())
    }
}

/// Does all runs of a study that have no result yet. A run that fails is reported and the others continue, also when a device
/// is lost or another process is busy with a run. Runs that cannot be done at this time are retried by the next call.
///
/// # Errors
/// [`Error::Interrupted`] after a cancel; immediately, errors that prevent further runs, such as no device or results that
/// cannot be written; at the end, the first error of a run that could not be done at this time.
pub fn work_off(study: &Study, place: &Workplace<'_>, observe: Observe<'_>) -> Result<Summary> {
    let runs = study.runs();
    let mut times = Times::new(study);
    let (mut waiting, mut failed, mut put_off) = (Vec::new(), 0, None);
    for (index, run) in runs.iter().enumerate() {
        match place.done(study, run)? {
            None => waiting.push((index, run)),
            Some(outcome) => {
                failed += usize::from(outcome.failure.is_some());
                times.note(run, &outcome);
            }
        }
    }
    let mut done = runs.len() - waiting.len();
    observe(&StudyEvent::Begun { runs: runs.len(), done });
    for (place_in_queue, (index, run)) in waiting.iter().enumerate() {
        let to_come: Vec<&Run> = waiting[place_in_queue..].iter().map(|(_, run)| *run).collect();
        let left_s = times.left_s(&to_come);
        observe(&StudyEvent::RunBegun { run: &run.id, number: index + 1, of: runs.len(), left_s });
        match place.work(study, run, observe) {
            Ok(outcome) => {
                done += 1;
                failed += usize::from(outcome.failure.is_some());
                times.note(run, &outcome);
                observe(&StudyEvent::RunEnded {
                    run: &run.id,
                    failure: outcome.failure.as_deref(),
                    dice: outcome.scores.as_ref().and_then(|scores| scores.dice),
                    whole_s: outcome.seconds.whole,
                });
            }
            Err(error @ (Error::DeviceLost { .. } | Error::OutOfMemory { .. } | Error::Busy(_))) => {
                observe(&StudyEvent::RunPutOff { run: &run.id, why: &error.to_string() });
                put_off.get_or_insert(error);
            }
            Err(error) => return Err(error),
        }
    }
    observe(&StudyEvent::Ended { runs: runs.len(), done, failed });
    match put_off {
        Some(error) => Err(error),
        None => Ok(Summary { runs: runs.len(), done, failed }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_left_is_that_of_the_same_method() {
        let mut times = Times { of_methods: vec![vec![10.0, 20.0], vec![], vec![60.0]] };
        let run = |method| Run { id: String::new(), data: 0, method, seed: 1 };
        let (a, b, c) = (run(0), run(1), run(2));
        assert_eq!(times.left_s(&[&a, &c]), Some(75.0));
        assert_eq!(times.left_s(&[&b]), Some(30.0), "the mean of all where the method has none");
        times.of_methods = vec![Vec::new(); 3];
        assert_eq!(times.left_s(&[&a]), None);
    }
}
