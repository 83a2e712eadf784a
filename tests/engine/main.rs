//! Stages against their f64 twins, gradients, golden values, runs of fields, calibration, and the structure of the code.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "tests")]

#[path = "../common/mod.rs"]
mod common;
#[path = "../common/disagreeing.rs"]
mod disagreeing;
#[path = "../common/golden_fields.rs"]
mod golden_fields;
#[path = "../common/golden_file.rs"]
mod golden_file;
#[path = "../common/root.rs"]
mod root;

mod adjustment;
mod architecture;
mod between_phases;
mod calibration;
mod check;
mod degradations;
mod documents;
mod few_phases;
mod golden;
mod golden_training;
mod gradients;
mod hull;
mod image_sizes;
mod kept_pipelines;
mod kernels_vs_cpu;
mod live_pictures;
mod messages;
mod networks;
mod phantom_settings;
mod projector;
mod refits;
mod schedules;
mod scoring;
mod session_ends;
mod session_prior;
mod session_slices;
mod soft_hull;
mod subgroups;
mod training;
