//! The registry of methods. To add a method, add its folder here, its line below, and its settings and preset in [`crate::config`].

pub mod dynamic_gaussians;
pub mod nerf_ca;
pub mod nert_ca;
pub mod r2_gaussian;
pub mod sax_nerf;
pub mod x_gaussian;

use crate::config::Config;
use crate::config::method::MethodKind;
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
    match config.method() {
        MethodKind::NertCa => &nert_ca::NertCa,
        MethodKind::NerfCa => &nerf_ca::NerfCa,
        MethodKind::DynamicGaussians => &DynamicGaussiansMethod,
        MethodKind::R2Gaussian => &r2_gaussian::R2Gaussian,
        MethodKind::XGaussian => &x_gaussian::XGaussian,
        MethodKind::SaxNerf => &sax_nerf::SaxNerf,
    }
}
