//! `selftest`: compares every compute stage with its f64 twin.

use crate::args::options::GlobalOptions;
use clap::Args;
use nertca_vk::error::{Error, Result};
use nertca_vk::gpu::capabilities::DeviceInfo;
use nertca_vk_twins::selftest::compare::Row;
use nertca_vk_twins::selftest::{self, Progress, Report};
use serde::Serialize;
use std::time::Instant;

/// Arguments of `selftest`.
#[derive(Debug, Args)]
pub struct SelftestArgs {
    /// Print JSON instead of text.
    #[arg(long)]
    pub json: bool,
}

/// Output of `--json`; together with that of `devices --json`, it has all that a bug report needs.
#[derive(Serialize)]
struct Answer<'a> {
    version: &'static str,
    commit: &'static str,
    device: &'a DeviceInfo,
    ok: bool,
    seconds: f64,
    #[serde(flatten)]
    report: &'a Report,
}

/// Runs the comparisons, prints a table, and fails when a stage differs from its twin.
pub fn run(global: &GlobalOptions, args: &SelftestArgs) -> Result<()> {
    let gpu = global.open_device()?;
    let begin = Instant::now();
    if !args.json {
        out!("{} ({})", gpu.info().name, gpu.info().driver);
        out!("{:9} {:>5} {:>9} {:>9}         stages", "path", "cases", "deviation", "tolerance");
    }
    let report = selftest::run(&gpu, &mut |progress| show(progress, args.json))?;
    let seconds = begin.elapsed().as_secs_f64();
    if args.json {
        let (version, commit) = (env!("CARGO_PKG_VERSION"), nertca_vk_study::COMMIT);
        let (device, ok) = (gpu.info(), report.is_ok());
        let answer = Answer { version, commit, device, ok, seconds, report: &report };
        out!("{}", nertca_vk::files::pretty_json(&answer)?);
    } else {
        print_end(&report, seconds);
    }
    global.close_device(&gpu)?;
    if report.is_ok() { Ok(()) } else { Err(Error::NoDevice(fault(gpu.info(), &report))) }
}

/// Prints each part when it begins, and its rows when it has ended.
fn show(progress: Progress<'_>, json: bool) {
    match progress {
        Progress::Begun { part, done, parts } => eprintln!("{} of {parts}: {part}", done + 1),
        Progress::Ended { .. } if json => {}
        Progress::Ended { rows, seconds } => {
            rows.iter().for_each(print_row);
            eprintln!("   {seconds:.1} s");
        }
    }
}

fn print_row(row: &Row) {
    let verdict = if row.is_ok() { "ok" } else { "FAILED" };
    let (path, name) = (&row.path, row.name());
    out!("{path:9} {:5} {:9.1e} {:9.1e} {verdict:7} {name}", row.cases, row.deviation, row.tolerance);
    if !row.is_ok() {
        out!("          in {}", row.seen_in);
    }
}

fn print_end(report: &Report, seconds: f64) {
    report.paths.iter().for_each(|path| out!("- {path}"));
    report.errors.iter().for_each(|failure| out!("FAILED  {}: {}", failure.part, failure.error));
    if !report.untested.is_empty() {
        out!("not tested: {}", report.untested.join(", "));
    }
    if report.is_ok() {
        out!("All {} comparisons are within their tolerances, in {seconds:.0} s.", report.rows.len());
    }
}

/// Describes the failure. The first failed stage is the relevant one, because the stages after it use its results.
fn fault(device: &DeviceInfo, report: &Report) -> String {
    let (failed, all) = (report.failed().count(), report.rows.len());
    let first = match (report.failed().next(), report.errors.first()) {
        (Some(row), _) => format!("the first is {} on the path {}", row.name(), row.path),
        (None, Some(failure)) => format!("{} ended with: {}", failure.part, failure.error),
        (None, None) => "nothing was compared".to_owned(),
    };
    format!(
        "{failed} of {all} comparisons failed on {} ({}), {first}. Do not rely on results of this device: try another \
         driver or --device. Please report this with the output of `nertca-vk selftest --json` and of `nertca-vk \
         devices --json`",
        device.name, device.driver
    )
}
