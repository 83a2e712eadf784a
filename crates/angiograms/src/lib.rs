//! X-ray angiograms with their geometry and phase, and what is known of them before anything is reconstructed: evidence of each view,
//! the calibration of views that disagree, and the diagnosis of the usual mistakes. This crate uses no device; its feature `gpu` adds the
//! errors of one to the error type, which all crates of the project share.
//!
//! A module uses only modules that stand above it in this file.

pub mod error;
pub mod fingerprint;
pub mod linear;

use nertca_vk_formats::{self as formats, files, raster};

pub mod geometry;

/// Angiograms with their geometry and phase.
pub mod scan {
    pub mod at_rest;
    mod builder;
    pub mod canvas;
    pub mod dataset;
    pub mod frame_checks;
    pub mod gating;
    pub mod hidden;
    pub mod nerfca;
    pub mod pixels;
    pub mod prior;
    mod reading;
    pub mod references;
    pub mod rtk;
    pub mod same_view;
    pub mod small;
    pub mod truth;
    pub mod writer;
}

/// Evidence of each single view: its static background, its noise, and where vessels may be.
pub mod evidence {
    pub mod background;
    pub mod drift;
    mod filters;
    mod interiors;
    pub mod lines;
    pub mod noise;
    pub mod ratios;
    pub mod series;
}

pub mod cine;

pub mod calibrate;

pub mod check;
