//! Methods of reconstruction, as a configuration chooses them.

use crate::config::{Config, dynamic_gaussians, nerf_ca, r2_gaussian, sax_nerf, x_gaussian};
use crate::error::Result;

/// A method of reconstruction. Each has settings of its own beside those that all methods share.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum MethodKind {
    /// A static tensor field and a dynamic network, as in NerT-CA.
    NertCa,
    /// Two networks, as in NeRF-CA.
    NerfCa,
    /// Gaussians as the dynamic field in front of a static tensor field.
    DynamicGaussians,
    /// Static Gaussians with line integrals.
    R2Gaussian,
    /// Static Gaussians of which nearer ones hide those behind them.
    XGaussian,
    /// A hash grid and a Lineformer.
    SaxNerf,
}

impl MethodKind {
    /// Refuses settings that the method does not support, or that contradict each other.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] naming the key.
    pub(super) fn check(self, config: &Config) -> Result<()> {
        match self {
            MethodKind::NertCa => Ok(()),
            MethodKind::NerfCa => nerf_ca::check(config),
            MethodKind::DynamicGaussians => dynamic_gaussians::check(config),
            MethodKind::R2Gaussian => r2_gaussian::check(config),
            MethodKind::XGaussian => x_gaussian::check(config),
            MethodKind::SaxNerf => sax_nerf::check(config),
        }
    }

    /// Returns the name of the method, for messages.
    pub fn name(self) -> &'static str {
        match self {
            MethodKind::NertCa => "a tensor field and a network",
            MethodKind::NerfCa => "two networks (static.form = \"network\")",
            MethodKind::DynamicGaussians => "Gaussians in front of a tensor field (gaussians.form)",
            MethodKind::R2Gaussian => "R2-Gaussian",
            MethodKind::XGaussian => "X-Gaussian",
            MethodKind::SaxNerf => "SAX-NeRF",
        }
    }

    /// Tells whether the method is fitted to whole images by itself, without a static field.
    pub fn is_alone(self) -> bool {
        matches!(self, MethodKind::R2Gaussian | MethodKind::XGaussian | MethodKind::SaxNerf)
    }

    /// Tells whether pictures of the dynamic field are blended, from about 0 to 1, so that they show no attenuation.
    pub fn is_blended(self) -> bool {
        self == MethodKind::XGaussian
    }

    /// Tells whether the dynamic field is a network on encoded coordinates.
    pub fn has_network(self) -> bool {
        matches!(self, MethodKind::NertCa | MethodKind::NerfCa)
    }
}
