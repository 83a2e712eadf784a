//! Options that several commands share, and parsers of values. Each command's own options are in its module.

use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use nertca_vk::choice::Choice;
use nertca_vk::config::{Config, Preset};
use nertca_vk::error::Result;
use nertca_vk::kernels::tuning::Layers;
use std::path::PathBuf;

/// Options that every command accepts.
#[derive(Debug, Args)]
pub struct GlobalOptions {
    /// Vulkan device: index, part of the name, or UUID (see `devices`); the best one by default.
    #[arg(long, global = true, value_name = "DEVICE")]
    pub device: Option<String>,
    /// Path of the network's layers: `f32`, or `matrices` (cooperative matrices: f16 operands, f32 sums); by default
    /// the faster one on the device.
    #[arg(long, global = true, value_parser = choice::<Layers>(), value_name = "PATH")]
    pub layers: Option<Layers>,
    /// Turn the Vulkan validation layers on (slow; messages make the program fail).
    #[arg(long, global = true)]
    pub validate: bool,
    /// Print more messages to stderr.
    #[arg(short, long, global = true)]
    pub verbose: bool,
}

/// Returns a parser for the names of a choice.
pub(crate) fn choice<T: Choice>() -> impl TypedValueParser<Value = T> {
    PossibleValuesParser::new(T::ALL.iter().map(|choice| choice.name()))
        .try_map(|name| T::named(&name).ok_or("is not one of the choices"))
}

/// Parses `A,B`.
pub(crate) fn pair(text: &str) -> Option<[f64; 2]> {
    let (a, b) = text.split_once(',')?;
    Some([a.trim().parse().ok()?, b.trim().parse().ok()?])
}

/// Hyper-parameters, for every command that trains.
#[derive(Debug, Args)]
pub struct ConfigArgs {
    /// Set of defaults: `fast` (deformable set of Gaussians; normalised, tuned), `fast-mlp` (a dynamic network;
    /// normalised, tuned), `paper` (as described in the paper), `public-code` (as in the authors' code), `nert-ca` (the same
    /// with what it needs on data of other sizes), `nerf-ca` (two
    /// networks; a method that the paper compares with), `r2-gaussian`, `x-gaussian` or `sax-nerf` (static methods that
    /// the paper compares with, fitted to each phase: Gaussians, Gaussians that occlude each other, or a hash grid with
    /// a network); `fast`, unless a configuration file names one.
    #[arg(long, value_parser = choice::<Preset>())]
    pub preset: Option<Preset>,
    /// TOML file with hyper-parameters.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Set one hyper-parameter, e.g. --set dynamic.width=128. Repeatable; takes precedence over the file.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    pub set: Vec<String>,
}

impl ConfigArgs {
    /// Builds the configuration; `more` settings are applied after those given with --set.
    pub fn load(&self, more: impl IntoIterator<Item = String>) -> Result<Config> {
        let settings: Vec<String> = self.set.iter().cloned().chain(more).collect();
        Config::load(self.preset, self.config.as_deref(), &settings)
    }
}

/// Parses `X,Y,Z`.
pub(crate) fn triple<T: std::str::FromStr>(text: &str) -> std::result::Result<[T; 3], String> {
    let parts: Vec<T> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    parts.try_into().map_err(|_| "three numbers are needed, written as X,Y,Z".to_owned())
}
