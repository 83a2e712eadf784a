//! The presets, each in the file of its method.

use crate::config::{Config, Preset, dynamic_gaussians, nerf_ca, nert_ca, r2_gaussian, sax_nerf, x_gaussian};

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
