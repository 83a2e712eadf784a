//! `study`: many runs described by one file, and tables of their results.

use crate::args::options::GlobalOptions;
use crate::command::data::bar;
use crate::pages::study_page;
use crate::progress::{show_progress, stop_flag};
use clap::{Args, Subcommand};
use nertca_vk::error::Result;
use nertca_vk::files;
use nertca_vk_study::COMMIT;
use nertca_vk_study::events::StudyEvent;
use nertca_vk_study::file;
use nertca_vk_study::markup::{csv, latex, markdown};
use nertca_vk_study::outcome::{RESULTS, Results};
use nertca_vk_study::plan::{Run, RunFingerprint, Study};
use nertca_vk_study::queue::work_off;
use nertca_vk_study::table::Table;
use nertca_vk_study::work::Workplace;
use serde::Serialize;
use std::path::PathBuf;

/// Environment variable with the directory of the study's external files, used without --data.
const DATA_VARIABLE: &str = "NERTCA_DATA";

/// Arguments of `study`.
#[derive(Debug, Args)]
pub struct StudyArgs {
    /// Operation on the study.
    #[command(subcommand)]
    pub command: StudyCommand,
}

/// Operations on a study.
#[derive(Debug, Subcommand)]
pub enum StudyCommand {
    /// Execute all runs that have no result yet, and continue interrupted runs.
    Run(RunArgs),
    /// Execute one run, for use by schedulers. Exit code 0: the run has its result, which may be a failure; 75: try
    /// again.
    One(OneArgs),
    /// List the runs.
    List(ListArgs),
    /// Write table.md, table.csv and table.tex into DIR, and the first to stdout.
    Table(PlaceArgs),
    /// Write results.jsonl into DIR: the results of all runs, one JSON object per line. Tables and report are made from it where a run
    /// has no directory.
    Collect(PlaceArgs),
    /// Write report.html into DIR: the table, Dice over time, and pictures of all methods; and dice-DATA.svg, Dice over time
    /// for each data set.
    Report(PlaceArgs),
}

/// Arguments that name a study and its files.
#[derive(Debug, Args)]
pub struct FileArgs {
    /// Study file (TOML).
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Directory in which the study's relative paths are looked up first, before the directory of the study file;
    /// $NERTCA_DATA by default.
    #[arg(long, value_name = "DIR")]
    pub data: Option<PathBuf>,
}

/// Arguments that name a study and its directory.
#[derive(Debug, Args)]
pub struct PlaceArgs {
    /// Study file and its data.
    #[command(flatten)]
    pub study: FileArgs,
    /// Directory of the study's data and runs.
    #[arg(short, long, value_name = "DIR")]
    pub out: PathBuf,
}

/// Options of executing runs.
#[derive(Debug, Args)]
pub struct DoingArgs {
    /// Study and its directory.
    #[command(flatten)]
    pub place: PlaceArgs,
    /// Also repeat runs that failed.
    #[arg(long)]
    pub retry_failed: bool,
    /// Also count results of other commits of this program as done, if their data and configuration are those of the
    /// study.
    #[arg(long)]
    pub any_commit: bool,
    /// Print one JSON object per line on stdout instead of progress.
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `study run`.
#[derive(Debug, Args)]
pub struct RunArgs {
    /// Options of executing runs.
    #[command(flatten)]
    pub doing: DoingArgs,
}

/// Arguments of `study one`.
#[derive(Debug, Args)]
pub struct OneArgs {
    /// Options of executing runs.
    #[command(flatten)]
    pub doing: DoingArgs,
    /// Run to execute, by its name in `study list`.
    #[arg(value_name = "RUN")]
    pub run: String,
}

/// Arguments of `study list`.
#[derive(Debug, Args)]
pub struct ListArgs {
    /// Study file and its data.
    #[command(flatten)]
    pub study: FileArgs,
    /// Directory of the study's runs, to show which of them have a result.
    #[arg(short, long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Count results of other commits of this program, as `study run --any-commit` does.
    #[arg(long, requires = "out")]
    pub any_commit: bool,
    /// Print JSON instead of lines.
    #[arg(long)]
    pub json: bool,
}

impl FileArgs {
    fn read(&self) -> Result<Study> {
        let data = self.data.clone().or_else(|| std::env::var_os(DATA_VARIABLE).map(PathBuf::from));
        file::read(&self.file, data.as_deref())
    }
}

/// Executes the operation.
pub fn run(global: &GlobalOptions, args: &StudyArgs) -> Result<()> {
    match &args.command {
        StudyCommand::Run(args) => queue(global, &args.doing),
        StudyCommand::One(args) => one(global, args),
        StudyCommand::List(args) => list(args),
        StudyCommand::Table(args) => table(args),
        StudyCommand::Collect(args) => collect(args),
        StudyCommand::Report(args) => report(args),
    }
}

/// Executes work at the place where a study's runs are done.
fn at_work<T>(
    global: &GlobalOptions,
    args: &DoingArgs,
    work: impl FnOnce(&Study, &Workplace<'_>, &mut dyn FnMut(&StudyEvent<'_>)) -> Result<T>,
) -> Result<T> {
    let study = args.place.study.read()?;
    warn_of_edits();
    let cancel = stop_flag()?;
    let place = Workplace {
        results: Results::open(&args.place.out)?,
        open: &|| global.open_device(),
        close: &|gpu| global.close_device(gpu),
        tune: &|gpu, config, dataset| global.training_tuning(gpu, config, dataset),
        cancel: &cancel,
        retry_failed: args.retry_failed,
        any_commit: args.any_commit,
    };
    if args.json { work(&study, &place, &mut print_json) } else { work(&study, &place, &mut show()) }
}

/// Warns if this build has uncommitted edits. Results are identified by their commit, which does not include such
/// edits.
fn warn_of_edits() {
    if COMMIT == "unknown" || COMMIT.ends_with("-dirty") {
        eprintln!(
            "warning: this program was built from uncommitted sources ({COMMIT}), so results of other uncommitted \
             sources also count as done"
        );
    }
}

fn queue(global: &GlobalOptions, args: &DoingArgs) -> Result<()> {
    let summary = at_work(global, args, |study, place, observe| work_off(study, place, observe))?;
    if summary.failed > 0 {
        eprintln!(
            "warning: {} of {} runs failed; the table has the reasons, and --retry-failed repeats them",
            summary.failed, summary.runs
        );
    }
    Ok(())
}

fn one(global: &GlobalOptions, args: &OneArgs) -> Result<()> {
    let (run, outcome) = at_work(global, &args.doing, |study, place, observe| {
        let run = study.run(&args.run)?;
        let outcome = place.work(study, &run, observe)?;
        Ok((run, outcome))
    })?;
    if let Some(failure) = &outcome.failure {
        eprintln!("warning: {} failed: {failure}", run.id);
    }
    Ok(())
}

/// Run in the output of `study list --json`.
#[derive(Serialize)]
struct Listed<'a> {
    #[serde(flatten)]
    run: &'a Run,
    data: &'a str,
    method: &'a str,
    iterations: u32,
    /// Fingerprint of its inputs: a different fingerprint means a different run.
    fingerprint: RunFingerprint,
    /// State `scored`, `failed` or `waiting`; none where no directory was given.
    #[serde(skip_serializing_if = "Option::is_none")]
    state: Option<&'static str>,
}

fn list(args: &ListArgs) -> Result<()> {
    let study = args.study.read()?;
    let runs = study.runs();
    let results = args.out.as_deref().map(Results::open).transpose()?;
    let mut listed = Vec::new();
    for run in &runs {
        let state = match &results {
            None => None,
            Some(results) => Some(match results.of(&study, run, args.any_commit)? {
                None => "waiting",
                Some(outcome) if outcome.failure.is_some() => "failed",
                Some(_) => "scored",
            }),
        };
        let (data, method) = (study.data[run.data].id.as_str(), &study.methods[run.method]);
        let (iterations, fingerprint) = (study.config(run).train.iterations, study.fingerprint(run)?);
        listed.push(Listed { run, data, method: &method.name, iterations, fingerprint, state });
    }
    if args.json {
        out!("{}", files::pretty_json(&listed)?);
    } else {
        listed.iter().for_each(|listed| match listed.state {
            Some(state) => out!("{state:8} {}", listed.run.id),
            None => out!("{}", listed.run.id),
        });
    }
    Ok(())
}

fn table(args: &PlaceArgs) -> Result<()> {
    let table = Table::gather(&args.study.read()?, &args.out)?;
    let text = markdown(&table);
    for (name, text) in [("table.md", &text), ("table.csv", &csv(&table)), ("table.tex", &latex(&table))] {
        files::write_atomic(&args.out.join(name), text.as_bytes())?;
    }
    out!("{}", text.trim_end());
    Ok(())
}

fn collect(args: &PlaceArgs) -> Result<()> {
    let results = Results::open(&args.out)?.collect(&args.study.read()?)?;
    out!("{}: {results} results", args.out.join(RESULTS).display());
    Ok(())
}

fn report(args: &PlaceArgs) -> Result<()> {
    for name in study_page::write(&args.study.read()?, &args.out)? {
        out!("{}", args.out.join(name).display());
    }
    Ok(())
}

/// Prints an event as one line of JSON on stdout.
fn print_json(event: &StudyEvent<'_>) {
    if let Ok(line) = serde_json::to_string(event) {
        out!("{line}");
    }
}

/// Formats seconds in a unit that is easy to read.
fn duration(seconds: f64) -> String {
    match seconds {
        s if s < 100.0 => format!("{s:.0} s"),
        s if s < 6000.0 => format!("{:.0} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}

/// Returns an observer that prints a line per run on stderr, and the progress of the current run.
fn show() -> impl FnMut(&StudyEvent<'_>) {
    let (mut making, mut training) = (None, None);
    move |event| match event {
        StudyEvent::Begun { runs, done } => eprintln!("{runs} runs, {done} of them have results"),
        StudyEvent::RunBegun { run, number, of, left_s } => {
            let left = left_s.map_or(String::new(), |s| format!(", about {} left", duration(s)));
            eprintln!("[{number} of {of}] {run}{left}");
        }
        StudyEvent::Making { what, done, of, .. } => making.get_or_insert_with(bar)(what, *done, *of),
        StudyEvent::Run { event, .. } => {
            making = None;
            training.get_or_insert_with(show_progress)(event);
        }
        StudyEvent::RunEnded { run, failure, dice, whole_s } => {
            training = None;
            match failure {
                Some(failure) => eprintln!("{run} failed: {failure}"),
                None => {
                    let dice = dice.map_or("-".into(), |dice| format!("{dice:.3}"));
                    eprintln!("{run}: Dice {dice}, {}", duration(*whole_s));
                }
            }
        }
        StudyEvent::RunPutOff { run, why } => {
            training = None;
            eprintln!("{run} is postponed: {why}");
        }
        StudyEvent::Ended { runs, done, failed } => {
            eprintln!("{done} of {runs} runs have results, {failed} failed")
        }
    }
}
