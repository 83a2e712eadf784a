//! Events that a study reports to its observer.

use nertca_vk_runs::run::events::Event;
use serde::Serialize;

/// Event of a study; also a line of `study run --json`, whose kind is the value of `study`.
#[derive(Debug, Serialize)]
#[serde(tag = "study", rename_all = "snake_case")]
pub enum StudyEvent<'a> {
    /// The queue begins.
    Begun {
        /// Runs of the study.
        runs: usize,
        /// Runs that already have a result.
        done: usize,
    },
    /// A run begins or is resumed.
    RunBegun {
        /// Name of the run.
        run: &'a str,
        /// Number of the run, from 1.
        number: usize,
        /// Runs of the study.
        of: usize,
        /// Estimated seconds to the end of the study; none before runs have been timed.
        left_s: Option<f64>,
    },
    /// A phantom is being made.
    Making {
        /// Run that needs the phantom.
        run: &'a str,
        /// Step in progress.
        what: &'a str,
        /// Steps completed.
        done: u64,
        /// Steps in all.
        of: u64,
    },
    /// An event of a run.
    Run {
        /// Name of the run.
        run: &'a str,
        /// The event.
        #[serde(flatten)]
        event: &'a Event,
    },
    /// A run has its result.
    RunEnded {
        /// Name of the run.
        run: &'a str,
        /// Reason of the failure, if the run failed.
        failure: Option<&'a str>,
        /// Mean Dice of the dynamic field.
        dice: Option<f64>,
        /// Total duration of the run, seconds.
        whole_s: f64,
    },
    /// A run could not be done at this time; a later queue will retry it.
    RunPutOff {
        /// Name of the run.
        run: &'a str,
        /// Reason of the delay.
        why: &'a str,
    },
    /// The queue has ended.
    Ended {
        /// Runs of the study.
        runs: usize,
        /// Runs with a result.
        done: usize,
        /// Runs with a result that failed.
        failed: usize,
    },
}
