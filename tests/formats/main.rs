//! Files that are read: their right values, and clear errors for malformed ones.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "tests")]

#[path = "../common/mod.rs"]
mod common;
#[path = "../common/dicom.rs"]
mod dicom;
#[path = "../common/parsers.rs"]
mod parsers;
#[path = "../common/python.rs"]
mod python;
#[path = "../common/root.rs"]
mod root;
#[path = "../common/shared.rs"]
mod shared;

mod dicom_enhanced;
mod dicom_fragments;
mod dicom_runs;
mod dicom_structure;
mod import_frames;
mod malformed;
mod modality_luts;
mod nerfca;
mod pydicom;
mod real_data;
mod rtk;
mod same_view;
mod units_and_spaces;
