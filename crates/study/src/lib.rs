//! Studies: data sets x methods x seeds, described in one file. Each combination is run until it has a result, and the results
//! are put beside published values.
//!
//! 1. [`mod@file`] reads a study, [`data`] describes its angiograms, [`plan`] expands it into runs
//! 2. [`work`] does one run in the study's directory, [`queue`] does all of them; [`outcome`] is the result of a run
//! 3. [`mod@table`] puts outcomes beside [`published`] values; [`markup`] writes tables as Markdown, CSV and LaTeX
//!
//! A study's directory holds `data/` (phantoms, shared between methods), `runs/ID/` (run directories, each with its
//! `result.json`), `results.jsonl` (results that were collected) and `locks/`. See `docs/studies.md`.

pub mod data;
pub mod events;
pub mod file;
pub mod layout;
pub mod markup;
pub mod outcome;
pub mod plan;
pub mod published;
pub mod queue;
pub mod scores;
pub mod table;
mod text;
pub mod work;

/// Commit of this program. Results of another commit do not count as its own, and runs of another commit are not resumed.
pub const COMMIT: &str = env!("NERTCA_COMMIT");
