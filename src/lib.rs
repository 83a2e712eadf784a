//! 4D reconstruction of the beating coronary arteries from 3 or 4 X-ray angiography views, on Vulkan compute.
//!
//! Data flow, with the modules in their order:
//!
//! 1. [`scan`]: validated angiograms with geometry and phase -> line integrals (the crate `nertca-vk-import` reads clinical runs)
//! 2. [`evidence`]: static background, noise and possible vessels of each single view. From it, [`calibrate`] corrects the
//!    geometry of views that disagree, and [`mod@check`] names the mistake where they cannot be made to agree;
//!    [`plan`]: everything a run needs, which the method of the configuration prepares (a room of [`methods`] each)
//! 3. [`fields::step`]: one iteration of fields that rays are marched through, in this order: rays -> samples -> [`network`] -> loss
//!    -> gradients -> Adam. [`methods::dynamic_gaussians`] fits [`gaussians`] as the dynamic field instead
//! 4. [`train::trainer`]: a run of any method, many iterations per submit -> losses
//! 5. [`model`]: parameters, scales, hull and configuration; [`checkpoint`] keeps them and the state of the fit in one safetensors file
//! 6. [`render`]: any pose and phase -> projections and samples of the fields
//! 7. [`export`] writes them for other tools
//!
//! [`mod@bench`] measures the speed. All of them build on the compute stages in [`kernels`] and on crates that are modules here: [`gpu`],
//! Vulkan compute, and [`formats`], files that other tools read and write, know nothing of angiography; the modules of
//! `nertca-vk-angiograms` need no device. A module uses only modules that stand above it in this file.
//!
//! Above this crate are `nertca-vk-runs` (run directories, and reconstructions in memory to which frames can be added),
//! `nertca-vk-vessels` (centrelines, stenoses and scores), `nertca-vk-phantom` (synthetic data), and `nertca-vk-twins` (an f64 reference of every
//! compute stage, with which tests and the self-test compare the device).
//!
//! The following example turns a dataset into a reconstruction in memory:
//!
//! ```
//! use nertca_vk::export::volumes::{Compression, Format, VolumeExport, grid_over};
//! use nertca_vk::{config::*, gpu::device::*, kernels::tuning::Tuning, model::component::Component, plan::Plan};
//! use nertca_vk::{render::renderer::Renderer, scan::dataset::Dataset, train::trainer::Trainer};
//!
//! let gpu = Gpu::open(&DeviceOptions::default())?;
//! # let directory = tempfile::tempdir().unwrap();
//! # let (data, out) = (directory.path().join("data"), directory.path());
//! # let small = nertca_vk::scan::small::small_dataset(32, 32, 4)?;
//! # nertca_vk::scan::writer::convert(&small, nertca_vk::scan::dataset::Layout::Native, &data)?;
//! let dataset = Dataset::open(&data)?;
//! let config = Config::preset(Preset::Fast);
//! # let config = Config::load(Some(Preset::Fast), None, &["train.iterations=20".into()])?;
//!
//! // Train.
//! let tuning = Tuning::for_device(gpu.info());
//! let mut trainer = Trainer::new(&gpu, Plan::new(&config, &dataset)?, &dataset, tuning.clone())?;
//! while trainer.step() < config.train.iterations {
//!     trainer.advance(config.train.iterations)?;
//! }
//! let model = trainer.model()?;
//!
//! // Draw the first view at the first phase.
//! let renderer = Renderer::new(&gpu, &model, tuning)?;
//! let [width, height] = dataset.views[0].size;
//! let view = renderer.render(&dataset.views[0].rays, width, height, 0)?;
//! println!("the moving vessels' largest line integral: {}", view.dynamic_integral.iter().fold(0.0, |m, v| v.max(m)));
//!
//! // Export the vessels of all phases, on cells of 2 mm.
//! let export = VolumeExport {
//!     grid: grid_over(&model.scene, Component::Dynamic, 2.0)?,
//!     component: Component::Dynamic,
//!     phases: (0..dataset.n_phases).collect(),
//!     sequence: true,
//!     format: Format::Nrrd,
//!     compression: Compression::None,
//! };
//! let files = export.write(&renderer, &out.join("beat.seq.nrrd"), |_, _| {})?;
//! # assert!(view.dynamic_integral.iter().any(|v| *v > 0.0) && files[0].is_file());
//! # Ok::<(), nertca_vk::error::Error>(())
//! ```
//!
//! Public functions take and return mm and degrees; inside, lengths are world units of 100 mm along (posterior, left,
//! superior).

pub mod choice;
pub mod random;
pub mod tensors;

/// Vulkan compute, independent of angiography: a crate of its own.
pub use nertca_vk_gpu as gpu;

/// Files that other tools read and write: a crate of its own.
pub use nertca_vk_formats as formats;
pub use nertca_vk_formats::{files, raster};

use nertca_vk_angiograms::linear;
/// Angiograms, and what is known of them without a device: a crate of its own.
pub use nertca_vk_angiograms::{calibrate, check, error, evidence, fingerprint, geometry, scan};

pub mod config;

/// The compute stages.
pub mod kernels {
    pub mod cache;
    pub mod constants;
    pub mod dispatch;
    pub mod layout;
    pub mod push;
    pub mod stages;
    pub mod tuning;
}

/// Gaussians, which several methods share: as data, in checkpoints, and on the device, where views see them.
pub mod gaussians {
    pub mod blending;
    pub mod blobs;
    pub mod comparison;
    pub mod field;
    pub mod particles;
    pub mod pictures;
    pub mod spacing;
    pub mod stages;
    pub(crate) mod tensors;
    pub mod view;
    pub mod work;
}

// A module uses only modules above it. Blank lines keep the formatter from sorting these.

pub mod model;

pub mod fitting;

pub mod network;

pub mod fields;

pub mod methods;

pub mod checkpoint;

pub mod plan;

/// Rendering of a model for any pose and phase.
pub mod render {
    mod backgrounds;
    pub mod baked;
    pub mod grid;
    mod kept_images;
    pub mod live;
    pub mod quantity;
    pub mod renderer;
    pub mod sample;
}

/// Training: from a plan to a checkpoint.
pub mod train {
    pub mod calibrate;
    pub mod dry_run;
    pub mod snapshot;
    pub mod timing;
    pub mod trainer;
    pub mod training;
}

/// Export of a model for other tools: volumes, surfaces and motion.
pub mod export {
    #[cfg(feature = "dicom")]
    pub mod dicom;
    pub mod motion;
    #[cfg(feature = "dicom")]
    pub mod presentation;
    #[cfg(feature = "dicom")]
    pub mod segmentation;
    pub mod splats;
    #[cfg(feature = "dicom")]
    pub mod structured;
    pub mod surfaces;
    pub mod volumes;
}

pub mod bench;
