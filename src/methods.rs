//! The registry of methods. To add a method, add its folder here, its line below, and its settings and preset in [`crate::config`].

pub mod dynamic_gaussians;
pub mod nerf_ca;
pub mod nert_ca;
pub mod r2_gaussian;
pub mod sax_nerf;
pub mod x_gaussian;

use crate::config::{Config, Method as Settings};
use crate::fitting::fit::Method;
use dynamic_gaussians::DynamicGaussiansMethod;

/// All methods.
pub static METHODS: &[&dyn Method] = &[
    &nert_ca::NertCa,
    &nerf_ca::NerfCa,
    &DynamicGaussiansMethod,
    &r2_gaussian::R2Gaussian,
    &x_gaussian::XGaussian,
    &sax_nerf::SaxNerf,
];

/// Returns the method that a configuration chooses.
pub fn of(config: &Config) -> &'static dyn Method {
    match &config.method {
        Settings::NertCa(_) => &nert_ca::NertCa,
        Settings::NerfCa(_) => &nerf_ca::NerfCa,
        Settings::DynamicGaussians(_) => &DynamicGaussiansMethod,
        Settings::R2Gaussian(_) => &r2_gaussian::R2Gaussian,
        Settings::XGaussian(_) => &x_gaussian::XGaussian,
        Settings::SaxNerf(_) => &sax_nerf::SaxNerf,
    }
}
