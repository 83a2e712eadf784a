//! Reconstructions from beginning to end: [`run`] writes one to a directory, [`session`] keeps one in memory, to which frames can be
//! added. Both drive the engine, the crate `nertca-vk`.

use nertca_vk::{
    calibrate, check, checkpoint, config, error, files, fitting, formats, geometry, gpu, kernels, methods, model, plan,
    render, scan, train,
};
use nertca_vk_vessels::{score, trees};

pub mod prepare;

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
