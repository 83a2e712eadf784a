//! What a study tells its observer.

use crate::run::events::Event;
use serde::Serialize;

/// What a study tells its observer; also the lines of `study run --json`, told apart by `study`.
#[derive(Debug, Serialize)]
#[serde(tag = "study", rename_all = "snake_case")]
pub enum StudyEvent<'a> {
    /// The queue begins.
    Begun {
        /// Runs of the study.
        runs: usize,
        /// Those that have their result already.
        done: usize,
    },
    /// A run begins or goes on.
    RunBegun {
        /// Its name.
        run: &'a str,
        /// Its number, from 1.
        number: usize,
        /// Runs of the study.
        of: usize,
        /// Estimated seconds to the end of the study; none before runs have been timed.
        left_s: Option<f64>,
    },
    /// A phantom is being made.
    Making {
        /// The run that needs it.
        run: &'a str,
        /// What is being done.
        what: &'a str,
        /// Steps done.
        done: u64,
        /// Steps in all.
        of: u64,
    },
    /// What a run tells.
    Run {
        /// Its name.
        run: &'a str,
        /// What it tells.
        #[serde(flatten)]
        event: &'a Event,
    },
    /// A run has its result.
    RunEnded {
        /// Its name.
        run: &'a str,
        /// Why it failed, where it did.
        failure: Option<&'a str>,
        /// Mean Dice of the moving field.
        dice: Option<f64>,
        /// Seconds it took in all.
        whole_s: f64,
    },
    /// A run could not be done now; a later queue will.
    RunPutOff {
        /// Its name.
        run: &'a str,
        /// Why.
        why: &'a str,
    },
    /// The queue is through.
    Ended {
        /// Runs of the study.
        runs: usize,
        /// Those with a result.
        done: usize,
        /// Those of them that failed.
        failed: usize,
    },
}
