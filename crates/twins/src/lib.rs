//! f64 twins of the compute stages, the self-test that compares a device with them, and the inventory of pipelines as its driver compiles
//! them. Tests and `nertca-vk selftest` use this crate; no result depends on it.

use nertca_vk::{
    choice, config, error, fields, fitting, formats, gaussians, geometry, gpu, kernels, methods, model, network, plan,
    random, render, scan, train,
};

/// Reference implementations of the compute stages in f64: plain loops, no device. They serve tests and `selftest`; no result
/// depends on them.
pub mod reference {
    pub mod adam;
    pub mod blobs;
    pub mod dynamic_gaussians;
    pub mod field;
    pub mod gaussians;
    pub mod losses;
    pub mod march;
    pub mod maxima;
    pub mod networks;
    pub mod occupancy;
    pub mod projector;
    pub mod r2_gaussian;
    pub mod r2_gaussian_chords;
    mod r2_gaussian_shape;
    pub mod sax_nerf;
    pub mod ssim;
    pub mod step;
    pub mod x_gaussian;
}

pub mod inventory;
pub mod selftest;
