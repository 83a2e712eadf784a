//! 4D reconstruction of the beating coronary arteries from 3 or 4 X-ray angiography views, on Vulkan compute.
//!
//! Data flow, with the modules in their order:
//!
//! 1. [`scan`]: validated angiograms with geometry and phase -> line integrals (`import`, of the feature `dicom`, reads
//!    clinical runs)
//! 2. [`evidence`]: static background, noise and possible vessels of each single view. From it, [`calibrate`] corrects the
//!    geometry of views that disagree, and [`mod@check`] names the mistake where they cannot be made to agree;
//!    [`plan`]: everything a run needs, which the method of the configuration prepares (a room of [`methods`] each)
//! 3. [`fields::step`]: one iteration of fields that rays are marched through, in this order: rays -> samples -> [`network`] -> loss
//!    -> gradients -> Adam. [`methods::dynamic_gaussians`] fits [`gaussians`] as the dynamic field instead
//! 4. [`train::trainer`]: a run of any method, many iterations per submit -> losses
//! 5. [`model`]: parameters, scales, hull and configuration; [`checkpoint`] keeps them and the state of the fit in one safetensors file
//! 6. [`render`]: any pose and phase -> projections and samples of the fields
//! 7. [`export`] writes them for other tools, [`score`] compares them with the images, [`trees`] extracts centrelines from them
//!
//! [`run`] connects these to a run directory, [`session`] is a reconstruction in memory to which frames can be added, and
//! [`capi`] is its C interface. [`phantom`] makes synthetic data, [`mod@bench`] measures the speed, and [`mod@reference`] holds an f64 reference of every compute stage, with which tests and `selftest`
//! compare the device; `inventory` lists pipelines as drivers compile them (both belong to the feature `diagnostics`). All of
//! them build on the compute stages in [`kernels`] and on two crates that know nothing of angiography: [`gpu`], Vulkan compute, and
//! [`formats`], files that other tools read and write. A module
//! uses only modules that stand above it in this file.
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
//! # let (data, out) = (directory.path().join("phantom"), directory.path());
//! # let options = nertca_vk::phantom::dataset::PhantomOptions {
//! #     setting: nertca_vk::phantom::dataset::Setting::SmallXcat,
//! #     size: 32,
//! #     phases: 4,
//! #     views: nertca_vk::phantom::views::ViewAngles::published(3)?,
//! #     seed: 1,
//! #     stenoses: Vec::new(),
//! #     degradations: Default::default(),
//! #     layout: nertca_vk::scan::dataset::Layout::Native,
//! #     anatomy: None,
//! #     volumes_every: None,
//! # };
//! # nertca_vk::phantom::dataset::make(&gpu, &options, &data, |_, _, _| ())?;
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
pub mod error;
pub mod fingerprint;
pub(crate) mod linear;
pub mod random;
pub mod tensors;

/// Vulkan compute, independent of angiography: a crate of its own.
pub use nertca_vk_gpu as gpu;

/// Files that other tools read and write: a crate of its own.
pub use nertca_vk_formats as formats;
pub use nertca_vk_formats::{files, raster};

pub mod geometry;

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

/// Angiograms with their geometry and phase.
pub mod scan {
    pub mod at_rest;
    mod builder;
    pub mod canvas;
    pub mod dataset;
    pub(crate) mod frame_checks;
    pub mod gating;
    pub(crate) mod hidden;
    pub mod nerfca;
    pub mod pixels;
    pub mod prior;
    mod reading;
    pub mod references;
    pub mod rtk;
    pub(crate) mod same_view;
    pub mod truth;
    pub mod writer;
}

/// Import of clinical runs into a dataset.
#[cfg(feature = "dicom")]
pub mod import {
    pub mod angiograms;
    mod beats;
    mod codecs;
    pub mod dicom;
    pub mod ecg;
    mod elements;
    mod enhanced;
    pub mod folder;
    mod frames;
    pub mod image_beat;
    pub mod intake;
    pub mod pictures;
    mod reader;
    mod sources;
    mod stands;
    pub mod stated;
    mod timing;
    mod traces;
    pub mod views_file;
}

/// Evidence of each single view: its static background, its noise, and where vessels may be.
pub mod evidence {
    pub mod background;
    pub mod drift;
    mod filters;
    mod interiors;
    pub mod noise;
    pub mod ratios;
    pub mod series;
}

pub mod calibrate;
pub mod check;

pub mod config;

/// Gaussians, which several methods share: as data, in checkpoints, and on the device, where views see them.
pub mod gaussians {
    pub mod blending;
    pub mod blobs;
    pub mod comparison;
    pub mod field;
    mod mean;
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

/// Vessels of the dynamic field, as sets of voxels.
pub mod vessels {
    pub mod centreline;
    pub mod distances;
    pub(crate) mod field;
    pub mod mask;
    pub mod threshold;
}

/// Vessels as trees of centrelines with radii, followed over the beat.
pub mod trees {
    pub mod areas;
    mod blur;
    mod branches;
    pub mod doubt;
    pub mod extract;
    pub mod files;
    mod follow;
    mod graph;
    mod information;
    pub mod lesions;
    #[cfg(feature = "dicom")]
    pub mod measurements;
    pub mod next_view;
    #[cfg(feature = "dicom")]
    pub mod over_frames;
    mod radii;
    mod refine;
    mod ridges;
    mod sampled;
    mod shadowed;
    mod shadows;
    pub mod sight;
    mod slides;
    mod solid;
    mod tidy;
    pub mod tree;
    mod tubes;
}

/// Quality measures of a reconstruction.
pub mod score {
    pub mod calibrated;
    pub mod ceiling;
    pub mod dice;
    pub mod distance;
    pub mod eval;
    pub mod lesions;
    pub mod metrics;
    mod nearest;
    pub mod pictures;
    pub mod shapes;
    pub mod trees;
    pub mod volume;
}

/// Synthetic data with exact truth.
pub mod phantom {
    mod blades;
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
}

/// One run, from a dataset to a run directory.
pub mod run {
    mod curve;
    pub mod events;
    pub mod history;
    pub mod hull_pictures;
    pub mod info;
    mod log;
    pub mod prior;
    pub mod reconstruct;
    pub mod score;
    pub mod silhouette_pictures;
    mod snapshots;
    pub mod tree_score;
}

pub mod session;

/// The C ABI: `include/nertca_vk.h` is generated from here.
#[allow(non_camel_case_types, reason = "types have the names they have in C")]
#[allow(unreachable_pub, reason = "what the modules share among themselves")]
pub mod capi {
    pub mod boundary;
    pub mod calibration;
    mod callsites;
    pub mod context;
    pub mod handles;
    pub mod log;
    pub mod options;
    pub mod output;
    pub mod reconstruction;
    pub mod semaphores;
    mod shared_memory;
    pub mod status;
    pub mod training;
    pub mod tree;
    pub mod truth;
    pub mod types;
}

pub mod bench;

/// Reference implementations of the compute stages in f64: plain loops, no device. They serve tests and `selftest`; no result
/// depends on them.
pub mod reference {
    pub mod adam;
    pub mod blobs;
    pub mod field;
    pub mod gaussians;
    pub mod losses;
    pub mod march;
    pub mod maxima;
    pub mod networks;
    pub mod occupancy;
    pub mod projector;
    pub mod ssim;
    pub mod step;
}

#[cfg(feature = "diagnostics")]
pub mod inventory;
#[cfg(feature = "diagnostics")]
pub mod selftest;
