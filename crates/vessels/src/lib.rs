//! Vessels of a reconstruction: as voxels, as trees of centrelines with radii and stenoses, and their scores against the truth.

#[cfg(test)]
use nertca_vk::random;
use nertca_vk::{
    calibrate, error, evidence, export, files, formats, gaussians, geometry, kernels, model, raster, render, scan,
};
use nertca_vk_angiograms::linear;

/// Vessels of the dynamic field, as sets of voxels.
pub mod vessels {
    pub mod centreline;
    pub mod distances;
    pub mod field;
    pub mod mask;
    pub mod threshold;
}

/// Vessels as trees of centrelines with radii, followed over the beat.
pub mod trees {
    pub mod areas;
    pub mod doubt;
    pub mod extract;
    pub mod files;
    mod information;
    pub mod lesions;
    pub mod next_view;
    mod refine;
    mod ridges;
    mod sampled;
    pub mod sight;
    pub mod tree;
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
