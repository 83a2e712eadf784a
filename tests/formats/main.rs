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

#[cfg(feature = "dicom")]
mod dicom_enhanced;
#[cfg(feature = "dicom")]
mod dicom_fragments;
#[cfg(feature = "dicom")]
mod dicom_runs;
#[cfg(feature = "dicom")]
mod dicom_structure;
#[cfg(feature = "dicom")]
mod image_beat;
#[cfg(feature = "dicom")]
mod import_frames;
mod malformed;
#[cfg(feature = "dicom")]
mod modality_luts;
mod nerfca;
#[cfg(feature = "dicom")]
mod pydicom;
mod real_data;
mod rtk;
mod same_view;
mod units_and_spaces;
