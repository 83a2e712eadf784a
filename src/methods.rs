//! The registry of methods. To add a method, add its folder here, its line below, and its settings and preset in [`crate::config`].

pub mod dynamic_gaussians;
pub mod nerf_ca;
pub mod nert_ca;
pub mod r2_gaussian;
pub mod sax_nerf;
pub mod x_gaussian;

use crate::config::{Config, Method as Settings};
use crate::fitting::fit::Method;

/// All methods.
pub static METHODS: [&Method; 6] = [
    &nert_ca::METHOD,
    &nerf_ca::METHOD,
    &dynamic_gaussians::METHOD,
    &r2_gaussian::METHOD,
    &x_gaussian::METHOD,
    &sax_nerf::METHOD,
];

/// Returns the method that a configuration chooses.
pub fn of(config: &Config) -> &'static Method {
    match &config.method {
        Settings::NertCa(_) => &nert_ca::METHOD,
        Settings::NerfCa(_) => &nerf_ca::METHOD,
        Settings::DynamicGaussians(_) => &dynamic_gaussians::METHOD,
        Settings::R2Gaussian(_) => &r2_gaussian::METHOD,
        Settings::XGaussian(_) => &x_gaussian::METHOD,
        Settings::SaxNerf(_) => &sax_nerf::METHOD,
    }
}
