//! Command-line arguments: commands, and the options that several commands share. Each command's own options are in its
//! module.

use super::bench::BenchArgs;
use super::calibrate::CalibrateArgs;
use super::check::CheckArgs;
use super::data::ImportArgs;
use super::devices::{CompletionsArgs, DevicesArgs};
use super::eval::EvalArgs;
use super::export::{ConvertArgs, ExportArgs};
use super::info::InfoArgs;
use super::kernels::KernelsArgs;
use super::render::RenderArgs;
use super::selftest::SelftestArgs;
use super::study::StudyArgs;
use super::synthetic_args::{PhantomArgs, ProjectArgs};
use super::train::TrainArgs;
use super::tree::TreeArgs;
use super::view::ViewArgs;
use super::watch::WatchArgs;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use clap::{Args, Parser, Subcommand};
use nertca_vk::choice::Choice;
use nertca_vk::config::{Config, Preset};
use nertca_vk::error::Result;
use nertca_vk::kernels::tuning::Layers;
use std::path::PathBuf;

/// 4D reconstruction of the beating coronary arteries from 3 or 4 X-ray angiography views.
#[derive(Debug, Parser)]
#[command(version, about, arg_required_else_help = true)]
pub struct Cli {
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
    /// Command to run.
    #[command(subcommand)]
    pub command: Command,
}

/// Commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// List the Vulkan devices, their limits, and the code paths that are used on them.
    Devices(DevicesArgs),
    /// Make a synthetic dataset with exact masks.
    Phantom(PhantomArgs),
    /// Make a dataset from projections of voxel volumes, one volume per phase.
    Project(ProjectArgs),
    /// Import clinical data as a dataset.
    Import(ImportArgs),
    /// Reconstruct a dataset into a run directory.
    Train(TrainArgs),
    /// Score a run on views that it was not trained on.
    Eval(EvalArgs),
    /// Render a run from any angle at any phase.
    Render(RenderArgs),
    /// View a run in a browser: turn the C-arm with the mouse while the beat plays.
    View(ViewArgs),
    /// Reconstruct DICOM runs while they appear in a folder, and view the growing reconstruction in a browser.
    Watch(WatchArgs),
    /// Export volumes or vessel surfaces of a run for other tools.
    Export(ExportArgs),
    /// Extract the vessels of a run as trees: centrelines with radii in mm, tracked over the beat.
    Tree(TreeArgs),
    /// Correct views whose geometry is inconsistent, from the angiograms alone.
    Calibrate(CalibrateArgs),
    /// Convert a dataset between the native and the authors' layout.
    Convert(ConvertArgs),
    /// Measure iterations, passes and renderings against device limits and the 37 minutes of the paper.
    Bench(BenchArgs),
    /// Compare every compute stage on this device with its f64 reference; run this first on an unknown device.
    Selftest(SelftestArgs),
    /// List every pipeline that a preset uses, as the device's driver compiles it: registers, spills, size.
    Kernels(KernelsArgs),
    /// Run a study of data sets x methods x seeds, and write tables of its results next to published ones.
    Study(StudyArgs),
    /// Check whether a dataset is consistent, and name the usual mistakes that it has.
    Check(CheckArgs),
    /// Describe a dataset or a run.
    Info(InfoArgs),
    /// Print shell completions.
    Completions(CompletionsArgs),
}

/// Returns a parser for the names of a choice.
pub(super) fn choice<T: Choice>() -> impl TypedValueParser<Value = T> {
    PossibleValuesParser::new(T::ALL.iter().map(|choice| choice.name()))
        .try_map(|name| T::named(&name).ok_or("is not one of the choices"))
}

/// Parses `A,B`.
pub(super) fn pair(text: &str) -> Option<[f64; 2]> {
    let (a, b) = text.split_once(',')?;
    Some([a.trim().parse().ok()?, b.trim().parse().ok()?])
}

/// Hyper-parameters, for every command that trains.
#[derive(Debug, Args)]
pub struct ConfigArgs {
    /// Set of defaults: `fast` (deformable set of Gaussians; normalised, tuned), `fast-mlp` (a dynamic network;
    /// normalised, tuned), `paper` (as described in the paper), `public-code` (as in the authors' code), `nerf-ca` (two
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
pub(super) fn triple<T: std::str::FromStr>(text: &str) -> std::result::Result<[T; 3], String> {
    let parts: Vec<T> = text.split(',').filter_map(|part| part.trim().parse().ok()).collect();
    parts.try_into().map_err(|_| "three numbers are needed, written as X,Y,Z".to_owned())
}
