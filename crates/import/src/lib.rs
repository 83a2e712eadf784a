//! Import of clinical runs into a dataset, from DICOM files and from pictures.

use nertca_vk_angiograms::{error, fingerprint, geometry, scan};
use nertca_vk_formats::{self as formats, files, raster};

pub mod angiograms;
mod beats;
mod codecs;
pub mod dicom;
pub mod ecg;
mod elements;
mod enhanced;
pub mod folder;
mod frames;
pub mod intake;
mod orientation;
pub mod pictures;
mod reader;
mod sources;
mod stands;
pub mod stated;
mod timing;
mod traces;
mod ungated;
pub mod views_file;
