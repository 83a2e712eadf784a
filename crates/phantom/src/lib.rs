//! Synthetic data with exact truth: procedural and real anatomy, its projections, and what degrades real angiograms.

use nertca_vk::{choice, error, files, formats, geometry, gpu, kernels, random, raster, scan};

pub mod acquisition;
mod blades;
mod camera;
mod catheter;
pub mod dataset;
pub mod degradations;
mod inflow;
pub mod noise;
pub mod projector;
mod runs;
mod sight;
pub mod stenosis;
mod subjects;
pub mod tree;
pub mod tree_file;
pub mod views;
pub mod voxels;
