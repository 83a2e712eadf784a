//! Files that other tools read and write, independent of angiography: volumes, surfaces, centrelines and pictures.
//!
//! | module | content |
//! |---|---|
//! | [`volume`], [`volume_files`] | a scalar volume, read from any of the formats below |
//! | [`nrrd`], [`nifti`], [`metaimage`], [`npy`], [`raw`], [`vtk`] | volumes and arrays |
//! | [`mesh`], [`gltf`], [`vtp`], [`swc`] | surfaces and centrelines |
//! | [`raster`], [`images`], [`png`], [`image_limits`], [`frames`] | pictures |
//! | [`files`], [`decoders`] | atomic writing, locks, limited reading; panics of decoders that other projects wrote |
//!
//! Lengths are mm, and positions are patient coordinates (LPS) unless a format has others.

pub mod decoders;
pub mod error;
pub mod files;
#[cfg(feature = "frames")]
pub mod frames;
pub mod gltf;
pub mod igtl;
pub mod image_limits;
pub mod images;
pub mod mesh;
pub mod metaimage;
pub mod nifti;
pub mod npy;
pub mod nrrd;
pub mod png;
pub mod raster;
pub mod raw;
pub mod rtk;
pub mod splats;
pub mod swc;
pub mod volume;
pub mod volume_files;
pub mod vtk;
mod vtk_arrays;
pub mod vtp;
