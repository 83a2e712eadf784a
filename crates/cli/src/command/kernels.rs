//! `kernels`: lists the driver's compiler statistics of every pipeline that a preset uses.

use crate::args::options::{ConfigArgs, GlobalOptions};
use clap::Args;
use nertca_vk::choice::Choice;
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::gpu::device::{DeviceOptions, Gpu};
use nertca_vk_twins::inventory::{self, Compiled, GROWTH};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Arguments of `kernels`.
#[derive(Debug, Args)]
pub struct KernelsArgs {
    /// Hyper-parameters, which determine the pipelines' constants.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Cardiac phases of the dataset: layers on matrices have a column for each.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub phases: u32,
    /// Print JSON instead of text.
    #[arg(long)]
    pub json: bool,
    /// Compare with the file of an earlier --json, and fail if a kernel spills that did not before or is much larger.
    #[arg(long, value_name = "FILE")]
    pub compare: Option<PathBuf>,
}

/// Results; `--json` prints them and `--compare` reads them.
#[derive(Serialize, Deserialize)]
struct Answer {
    device: String,
    driver: String,
    /// Choices made for the device.
    paths: Vec<String>,
    preset: String,
    kernels: Vec<Compiled>,
}

/// Compiles, prints a table, and compares.
pub fn run(global: &GlobalOptions, args: &KernelsArgs) -> Result<()> {
    let config = args.config.load([])?;
    let before = args.compare.as_deref().map(|file| Ok::<_, Error>((file, read(file)?))).transpose()?;
    // No pipeline cache is used, because a pipeline from a cache is not compiled.
    let gpu = Gpu::open(&DeviceOptions {
        select: global.device.clone(),
        validation: global.validate,
        statistics: true,
        ..DeviceOptions::default()
    })?;
    let tuning = global.tuning(&gpu, &config);
    let kernels = inventory::compile(&gpu, &config, args.phases as usize, &tuning)?;
    let info = gpu.info();
    let answer = Answer {
        device: info.name.clone(),
        driver: info.driver.clone(),
        paths: tuning.for_network(config.has_network()).reasons,
        preset: config.preset.name().to_owned(),
        kernels,
    };
    if args.json {
        out!("{}", files::pretty_json(&answer)?);
    } else {
        print(&answer, info.pipeline_statistics);
    }
    global.close_device(&gpu)?;
    before.map_or(Ok(()), |(file, before)| compare(file, &before, &answer))
}

fn read(file: &Path) -> Result<Answer> {
    let text = std::fs::read(file).map_err(Error::io("read", file))?;
    serde_json::from_slice(&text)
        .map_err(|e| Error::data(file, "JSON", format!("{e}; a file that `kernels --json` wrote is needed")))
}

fn print(answer: &Answer, told: bool) {
    out!("{} ({}), preset {}", answer.device, answer.driver, answer.preset);
    answer.paths.iter().for_each(|path| out!("- {path}"));
    if !told {
        out!(
            "- the driver gives no statistics of the kernels that it compiles (it lacks \
             VK_KHR_pipeline_executable_properties), so the numbers are missing below"
        );
    }
    out!("lanes subgroup registers   spills shared resident     code   cycles kernel and constants");
    for kernel in &answer.kernels {
        let number = |value: Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.0}"));
        out!(
            "{:5} {:>8} {:>9} {:>8} {:>6} {:>8} {:>8} {:>8} {}",
            kernel.lanes,
            kernel.subgroup_size.map_or("-".to_owned(), |size| size.to_string()),
            number(kernel.registers),
            number(kernel.spills),
            number(kernel.shared_bytes),
            number(kernel.resident),
            number(kernel.code),
            number(kernel.cycles),
            kernel.name()
        );
    }
}

fn compare(file: &Path, before: &Answer, now: &Answer) -> Result<()> {
    if before.driver != now.driver {
        eprintln!("compared with {} ({})", before.device, before.driver);
    }
    let found = inventory::differences(&before.kernels, &now.kernels);
    found.other.iter().for_each(|other| eprintln!("{other}"));
    found.worse.iter().for_each(|worse| eprintln!("WORSE {worse}"));
    if found.worse.is_empty() {
        return Ok(());
    }
    let (n, percent) = (found.worse.len(), 100.0 * GROWTH);
    let problem = format!(
        "{n} of the current numbers, listed above, are worse: kernels spill, or numbers differ by more than \
         {percent:.0} %"
    );
    Err(Error::data(file, "kernels", problem))
}
