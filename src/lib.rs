//! 4D reconstruction of the beating coronary arteries from 3 or 4 X-ray angiography views.
pub mod config;
pub mod error;
pub mod files;
pub mod kernels;
pub mod layout;
pub mod reconstruct;
/// Vulkan compute, free of any knowledge of angiography.
pub mod gpu {
    pub mod device;
    pub mod memory;
    pub mod pipeline;
    pub mod record;
}
/// What comes in.
pub mod data {
    pub mod dataset;
    pub mod geometry;
    pub mod images;
    pub mod motion;
    pub mod nerfca;
    pub mod volume;
}
/// The fields.
pub mod model {
    pub mod field;
    pub mod params;
    pub mod scene;
}
/// CPU twins.
pub mod cpu {
    pub mod field;
    pub mod march;
    pub mod projector;
    pub mod random;
    pub mod step;
}
/// Training.
pub mod train {
    pub mod checkpoint;
    pub mod plan;
    pub mod step;
    pub mod trainer;
}

/// Synthetic data.
pub mod phantom {
    pub mod dataset;
    pub mod tree;
    pub mod voxels;
}
/// What goes out.
pub mod output {
    pub mod eval;
    pub mod metrics;
    pub mod pictures;
    pub mod projector;
    pub mod render;
}
