//! Commands of the program, and the function that executes each.

use crate::args::options::GlobalOptions;
use crate::args::synthetic_args::{PhantomArgs, ProjectArgs};
use crate::command::bench::{self, BenchArgs};
use crate::command::calibrate::{self, CalibrateArgs};
use crate::command::check::{self, CheckArgs};
use crate::command::data::{self, ImportArgs};
use crate::command::devices::{self, CompletionsArgs, DevicesArgs};
use crate::command::eval::{self, EvalArgs};
use crate::command::export::{self, ConvertArgs, ExportArgs};
use crate::command::info::{self, InfoArgs};
use crate::command::kernels::{self, KernelsArgs};
use crate::command::next::{self, NextArgs};
use crate::command::render::{self, RenderArgs};
use crate::command::selftest::{self, SelftestArgs};
use crate::command::study::{self, StudyArgs};
use crate::command::train::{self, TrainArgs};
use crate::command::tree::{self, TreeArgs};
use crate::progress::clean_up_on_signals;
use crate::viewer::view::{self, ViewArgs};
use crate::watch::{self, WatchArgs};
use clap::{CommandFactory, Parser, Subcommand};
use nertca_vk::error::Result;

/// Commands of a first session, below the list of all.
const FIRST_STEPS: &str = "\
First steps:
  nertca-vk phantom heart          make a synthetic dataset in the directory `heart`
  nertca-vk train heart            reconstruct it; the run is in `heart-run`, its page in `heart-run/report.html`
  nertca-vk view heart-run         turn the C-arm in a browser while the beat plays
Angiograms of your own: nertca-vk import dicom --help, or import pictures --help; docs/formats.md describes `dataset.json`.";

/// 4D reconstruction of the beating coronary arteries from 3 or 4 X-ray angiography views.
#[derive(Debug, Parser)]
#[command(name = "nertca-vk", version, arg_required_else_help = true, after_help = FIRST_STEPS)]
pub struct Cli {
    /// Options that every command accepts.
    #[command(flatten)]
    pub global: GlobalOptions,
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
    /// Import clinical data, DICOM files or pictures, as a dataset.
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
    /// Suggest the view to take next: where no vessel covers another, and new ones are seen.
    Next(NextArgs),
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

impl Command {
    /// Tells whether a command does nothing but write new files, so that nothing is lost where a signal ends it at once.
    fn only_writes(&self) -> bool {
        matches!(
            self,
            Command::Phantom(_)
                | Command::Project(_)
                | Command::Import(_)
                | Command::Render(_)
                | Command::Export(_)
                | Command::Tree(_)
                | Command::Next(_)
                | Command::Calibrate(_)
                | Command::Convert(_)
        )
    }
}

impl Cli {
    /// Executes the command.
    pub fn run(&self) -> Result<()> {
        let global = &self.global;
        if self.command.only_writes() {
            clean_up_on_signals()?;
        }
        match &self.command {
            Command::Devices(args) => devices::run(args),
            Command::Phantom(args) => data::phantom(global, args),
            Command::Project(args) => data::project(global, args),
            Command::Import(args) => data::import(args),
            Command::Train(args) => train::run(global, args),
            Command::Eval(args) => eval::eval(global, args),
            Command::Render(args) => render::render(global, args),
            Command::View(args) => view::view(global, args),
            Command::Watch(args) => watch::run(global, args),
            Command::Export(args) => export::export(global, args),
            Command::Tree(args) => tree::run(global, args),
            Command::Next(args) => next::run(global, args),
            Command::Calibrate(args) => calibrate::run(args),
            Command::Convert(args) => export::convert(args),
            Command::Bench(args) => bench::run(global, args),
            Command::Kernels(args) => kernels::run(global, args),
            Command::Selftest(args) => selftest::run(global, args),
            Command::Study(args) => study::run(global, args),
            Command::Check(args) => check::run(args),
            Command::Info(args) => info::info(args),
            Command::Completions(args) => devices::completions(args, &mut Cli::command()),
        }
    }
}
