//! All hyper-parameters; unknown keys are refused.
//!
//! A configuration consists of the values that all methods share and of those of one method, which the preset chooses. A key exists where
//! its value exists. Precedence: preset < TOML file < single settings `key=value`.
//!
//! This file is the registry of presets and methods: a method is added here and in a file of its own.

mod choices;
mod common;
mod configuration;
mod dynamic_gaussians;
pub mod fields;
mod length;
mod method;
mod nerf_ca;
mod nert_ca;
mod r2_gaussian;
mod reading;
mod sax_nerf;
mod section;
#[cfg(test)]
mod tests;
mod x_gaussian;

pub use choices::{AdjustMode, Decay, DynamicTarget, OcclusionRegion, R2Integral, R2Start, StaticData};
pub use configuration::Config;
pub(crate) use configuration::Shared;
pub use dynamic_gaussians::{CatheterChoice, GaussianForm};
pub use method::OfMethod;
use method::methods;
use sections::{GaussiansSettings, NerfCaSettings, NertCaSettings, R2Settings, SaxSettings, XSettings};
use serde::{Deserialize, Serialize};
use strum::{IntoStaticStr, VariantArray};

/// Sections of a configuration and the settings of each method: each hyper-parameter with its meaning and accepted range.
pub mod sections {
    pub use crate::config::common::{Calibrate, Render, Train};
    pub use crate::config::dynamic_gaussians::{Deformable, Gaussians, GaussiansSettings, LeftOut, Rule};
    pub use crate::config::fields::{Network, Networks, Tensor};
    pub use crate::config::nerf_ca::NerfCaSettings;
    pub use crate::config::nert_ca::{NertCaHull, NertCaSettings};
    pub use crate::config::r2_gaussian::{R2, R2Settings};
    pub use crate::config::sax_nerf::{Sax, SaxSettings};
    pub use crate::config::x_gaussian::{FIRST_OPACITY, X, XSettings};
}

/// A named set of defaults, which also chooses the method.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, IntoStaticStr, VariantArray)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Preset {
    /// Moving Gaussians in front of a static tensor field; the default.
    #[default]
    Fast,
    /// The paper's two fields with normalised data, a motion hull and tuned settings.
    FastMlp,
    /// The method as the paper states it.
    Paper,
    /// The method as the authors' public code implements it.
    PublicCode,
    /// The method as the authors' public code implements it, with a box and a network rate at which vessels appear on other data.
    NertCa,
    /// NeRF-CA, a baseline of the paper, as its public code implements it: both fields are networks.
    NerfCa,
    /// R2-Gaussian, a static baseline of the paper: Gaussians alone, fitted to each phase separately.
    R2Gaussian,
    /// X-Gaussian, a static baseline of the paper: Gaussians that hide each other, as in Gaussian splatting.
    XGaussian,
    /// SAX-NeRF, a static baseline of the paper: a hash grid and a Lineformer, fitted to each phase separately.
    SaxNerf,
}

impl Preset {
    /// Tells whether the preset is the method of the paper with its published settings, as the paper or its public code state them.
    pub fn is_published(self) -> bool {
        matches!(self, Preset::Paper | Preset::PublicCode)
    }
}

impl Config {
    /// Returns the defaults of a preset.
    pub fn preset(preset: Preset) -> Config {
        match preset {
            Preset::Fast => dynamic_gaussians::fast().into_any(),
            Preset::FastMlp => nert_ca::fast_mlp().into_any(),
            Preset::Paper => nert_ca::paper().into_any(),
            Preset::PublicCode => nert_ca::public_code().into_any(),
            Preset::NertCa => nert_ca::nert_ca().into_any(),
            Preset::NerfCa => nerf_ca::nerf_ca().into_any(),
            Preset::R2Gaussian => r2_gaussian::r2_gaussian().into_any(),
            Preset::XGaussian => x_gaussian::x_gaussian().into_any(),
            Preset::SaxNerf => sax_nerf::sax_nerf().into_any(),
        }
    }
}

methods! {
    /// A static tensor field and a dynamic network, as in NerT-CA.
    NertCa(NertCaSettings),
    /// Two networks, as in NeRF-CA.
    NerfCa(NerfCaSettings),
    /// Gaussians as the dynamic field in front of a static tensor field.
    DynamicGaussians(GaussiansSettings),
    /// Static Gaussians with line integrals.
    R2Gaussian(R2Settings),
    /// Static Gaussians of which nearer ones hide those behind them.
    XGaussian(XSettings),
    /// A hash grid and a Lineformer.
    SaxNerf(SaxSettings),
}

/// Values that chose the method in files of earlier versions, whatever their preset was: key, value, and the presets whose method they
/// chose.
const FORMS: [(&str, &str, &[Preset]); 12] = [
    ("static.form", "tensor", &[Preset::Fast, Preset::FastMlp, Preset::Paper, Preset::PublicCode]),
    ("static.form", "network", &[Preset::NerfCa]),
    ("static.form", "none", &[Preset::R2Gaussian, Preset::XGaussian, Preset::SaxNerf]),
    ("dynamic.form", "lineformer", &[Preset::SaxNerf]),
    ("gaussians.form", "none", &[Preset::FastMlp, Preset::Paper, Preset::PublicCode, Preset::NerfCa, Preset::SaxNerf]),
    ("gaussians.form", "r2", &[Preset::R2Gaussian]),
    ("gaussians.form", "x", &[Preset::XGaussian]),
    ("gaussians.form", "auto", &[Preset::Fast]),
    ("gaussians.form", "phase", &[Preset::Fast]),
    ("gaussians.form", "deformable", &[Preset::Fast]),
    ("gaussians.form", "tree", &[Preset::Fast]),
    // It changes lengths of paths through a model.
    ("march.along_axis", "true", &[Preset::NerfCa]),
];
