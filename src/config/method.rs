//! Methods of reconstruction, as a configuration chooses them.

use crate::config::length::DRY_RUN;
use crate::config::{Config, Preset, dynamic_gaussians, nerf_ca, nert_ca, r2_gaussian, sax_nerf, x_gaussian};
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

impl Config {
    /// Returns the defaults of a preset.
    pub fn preset(preset: Preset) -> Config {
        match preset {
            Preset::Fast => dynamic_gaussians::fast(),
            Preset::FastMlp => nert_ca::fast_mlp(),
            Preset::Paper => nert_ca::paper(),
            Preset::PublicCode => nert_ca::public_code(),
            Preset::NerfCa => nerf_ca::nerf_ca(),
            Preset::R2Gaussian => r2_gaussian::r2_gaussian(),
            Preset::XGaussian => x_gaussian::x_gaussian(),
            Preset::SaxNerf => sax_nerf::sax_nerf(),
        }
    }
}

/// Share of a schedule's length that a run of another length has.
pub(super) struct Scaled(pub(super) f64);

impl Scaled {
    /// Minimum number of iterations between two density controls of a shortened run: an iteration with density control learns
    /// nothing.
    const MIN_INTERVAL: u32 = 10;

    /// Returns a number of iterations of the run of another length.
    pub(super) fn count(&self, iterations: u32) -> u32 {
        (self.0 * f64::from(iterations)).round() as u32
    }

    /// Returns the number of iterations between two density controls of the run of another length; 0 stays 0.
    pub(super) fn interval(&self, iterations: u32) -> u32 {
        if iterations == 0 { 0 } else { self.count(iterations).max(Self::MIN_INTERVAL) }
    }
}

/// Settings of a method: the checks of their combinations, the keys, and the schedule.
pub(super) trait MethodSettings {
    /// Refuses settings that the method does not support, or that contradict each other.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] naming the key.
    fn check(&self, _config: &Config) -> Result<()> {
        Ok(())
    }

    /// Tells whether a setting, such as `static.lr`, is a key of a preset of this method.
    fn is_key(&self, preset: Preset, key: &str) -> bool;

    /// Returns the method's own settings, with their keys, that keep the schedule's shares of a run of another length.
    fn schedule(&self, _config: &Config, _scaled: &Scaled) -> Vec<(&'static str, u32)> {
        Vec::new()
    }

    /// Returns the iterations at which the method's own schedule changes something, in any order.
    fn events(&self, _config: &Config) -> Vec<u32> {
        Vec::new()
    }

    /// Returns the iterations of a dry run.
    fn dry_run_length(&self) -> u32 {
        DRY_RUN
    }

    /// Moves events that the schedule of a dry run of so many iterations would leave out.
    fn shorten(&self, _config: &mut Config, _iterations: u32) {}
}

impl MethodKind {
    /// Returns the settings of the method.
    pub(super) fn settings(self) -> &'static dyn MethodSettings {
        match self {
            MethodKind::NertCa => &nert_ca::Settings,
            MethodKind::NerfCa => &nerf_ca::Settings,
            MethodKind::DynamicGaussians => &dynamic_gaussians::Settings,
            MethodKind::R2Gaussian => &r2_gaussian::Settings,
            MethodKind::XGaussian => &x_gaussian::Settings,
            MethodKind::SaxNerf => &sax_nerf::Settings,
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
