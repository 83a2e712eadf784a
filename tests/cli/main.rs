//! The program `nertca-vk` as users run it.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "tests")]

#[path = "../common/c_scene.rs"]
mod c_scene;
#[path = "../common/mod.rs"]
mod common;
#[path = "../common/dicom.rs"]
mod dicom;
#[path = "../common/known_tree.rs"]
mod known_tree;
#[path = "../common/program.rs"]
mod program;
#[path = "../common/python.rs"]
mod python;
#[path = "../common/root.rs"]
mod root;
#[path = "../common/said.rs"]
mod said;
#[path = "../common/shared.rs"]
mod shared;

mod calibrated_scores;
#[cfg(unix)]
mod campaign;
mod capi_truth;
mod dicom_export;
mod first_session;
mod gaussian_runs;
mod igtl;
mod imperfect_angiograms;
mod inflow;
mod interfaces;
mod interop;
mod lab_runs;
mod method_runs;
mod motion;
mod moving_runs;
mod network_runs;
mod positions;
mod presentation;
mod prior;
mod run_directories;
mod selftest;
mod stenosis;
mod study;
mod tree_files;
mod tree_pages;
mod trees;
mod viewer_ends;
mod volume_scores;
mod watch;
mod ways_in;
mod ways_out;
mod wide_vessels;
