//! Studies: data sets x methods x seeds as one file, run until each has its result, and put beside what is published.
//!
//! 1. [`mod@file`] reads a study, [`data`] says what its angiograms are made of, [`plan`] expands it into runs
//! 2. [`work`] does one run in the study's directory, [`queue`] all of them; [`outcome`] is what a run leaves
//! 3. [`mod@table`] puts outcomes beside [`published`] values; [`markup`] writes that as Markdown, CSV and LaTeX
//!
//! A study's directory holds `data/` (phantoms, shared between methods), `runs/ID/` (run directories, each with its
//! `result.json`) and `locks/`. See `docs/studies.md`.

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

/// Commit of this program: results of another one are not its own, and its runs are not gone on with.
pub const COMMIT: &str = env!("NERTCA_COMMIT");
