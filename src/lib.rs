//! 4D reconstruction of the beating coronary arteries from 3 or 4 X-ray angiography views, on Vulkan compute.
//!
//! The way of the data, and where to read it:
//!
//! 1. [`data::dataset`]: angiograms with geometry and phase, validated -> line integrals
//! 2. [`data::motion`]: what moves -> still backgrounds and the motion hull
//! 3. [`train::plan`]: scales, boxes, schedules -> everything a run needs
//! 4. [`train::step`]: one iteration, top to bottom: rays -> samples -> fields -> loss -> gradients -> Adam
//! 5. [`train::trainer`]: many iterations per submit, two submits in flight -> losses
//! 6. [`train::checkpoint`]: parameters, moments, step, configuration -> one safetensors file
//! 7. [`output::render`], [`output::eval`]: any pose and phase -> pictures and scores
//!
//! [`session`] is a reconstruction in memory that grows with its frames, [`capi`] the same for C.
//! [`reconstruct`] ties these to a run directory, [`report`] scores it, [`mod@bench`] times it, [`phantom`] makes data to
//! try them on, [`cpu`] holds an f64 twin of every stage, and [`gpu`] is Vulkan without any knowledge of angiography.
//! Public functions speak mm and degrees; inside, lengths are world units of 100 mm along (posterior, left, superior).

pub mod bench;
pub mod calibrate;
pub mod config;
pub mod error;
pub mod files;
pub mod kernels;
pub mod layout;
pub mod reconstruct;
pub mod report;
pub mod schedule;
pub mod session;

/// Vulkan compute, free of any knowledge of angiography.
pub mod gpu {
    pub mod capabilities;
    pub mod device;
    pub mod memory;
    pub mod pipeline;
    pub mod record;
    pub mod volume;
}

/// What comes in: geometry, angiograms, volumes, and what moves in them.
pub mod data {
    pub mod dataset;
    pub mod dicom;
    mod dicom_lengths;
    pub mod ecg;
    pub mod gating;
    pub mod geometry;
    pub mod images;
    pub mod import;
    pub mod motion;
    pub mod nerfca;
    pub mod volume;
    pub mod writer;
}

/// The soft motion hull: which cells may hold a moving vessel, by likelihood instead of certainty.
pub mod soft_hull {
    pub mod background;
    pub mod carve;
    pub mod evidence;
    mod filters;
}

/// Gaussians as the moving field.
pub mod gaussians {
    pub mod layout;
    pub mod maxima;
    pub mod model;
    pub mod reference;
    pub mod scene;
    pub mod seed;
    pub mod settings;
    pub mod stages;
    pub mod trainer;
    pub mod view;

    /// One set for the whole beat.
    pub mod tree {
        pub mod layout;
        pub mod model;
        pub mod reference;
        pub mod settings;
        pub mod stages;
        pub mod trainer;
    }
}

/// The fields: their parameters, and the scene they live in.
pub mod model {
    pub mod field;
    pub mod params;
    pub mod scene;
}

/// f64 twins of the compute stages: plain loops, no device.
pub mod cpu {
    pub mod field;
    pub mod march;
    pub mod occupancy;
    pub mod projector;
    pub mod random;
    pub mod step;
}

/// From a plan to a checkpoint.
pub mod train {
    pub mod checkpoint;
    pub mod fused;
    pub mod layers;
    pub mod network;
    pub mod plan;
    pub mod step;
    pub mod trainer;
}

/// What goes out: renderings, scores, pictures, projections of volumes.
pub mod output {
    pub mod eval;
    pub mod export;
    pub mod live;
    pub mod mesh;
    pub mod metrics;
    pub mod page;
    pub mod pictures;
    pub mod projector;
    pub mod render;
    pub mod sampled;
}

/// The C ABI: `include/nertca_vk.h` is generated from here.
#[allow(non_camel_case_types, reason = "types have the names they have in C")]
#[allow(unreachable_pub, reason = "what the modules share among themselves")]
pub mod capi {
    pub mod context;
    pub mod handles;
    pub mod log;
    pub mod options;
    pub mod output;
    pub mod reconstruction;
    pub mod status;
    pub mod training;
    pub mod types;
}

/// Synthetic data with exact truth.
pub mod phantom {
    pub mod dataset;
    pub mod tree;
    pub mod voxels;
}
