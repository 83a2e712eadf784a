//! The registry of methods with a module of their own. To add a method, add its folder here, its line below, and its settings
//! and preset in [`crate::config`].

pub mod r2_gaussian;
pub mod sax_nerf;
pub mod x_gaussian;

use crate::config::Config;
use crate::fitting::fit::Method;

/// All methods with a module of their own.
pub static METHODS: &[&dyn Method] = &[&r2_gaussian::R2Gaussian, &x_gaussian::XGaussian, &sax_nerf::SaxNerf];

/// Returns the method that a configuration chooses; none for those that share the trainer of fields and Gaussians.
pub fn of(config: &Config) -> Option<&'static dyn Method> {
    METHODS.iter().copied().find(|method| method.kind() == config.method())
}
