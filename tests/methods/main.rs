//! The baselines and the fields of Gaussians: stages, golden values, starts, density control, runs.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "tests")]

#[path = "../common/mod.rs"]
mod common;
#[path = "../common/golden_file.rs"]
mod golden_file;
#[path = "../common/one_phase.rs"]
mod one_phase;
#[path = "../common/root.rs"]
mod root;

mod gaussian_field;
mod gaussians;
mod r2;
mod sax;
mod x_gaussian;
