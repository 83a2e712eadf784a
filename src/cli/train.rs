//! `train`: progress, Ctrl-C, report.

use super::args::{Cli, TrainArgs};
use super::eval::print_table;
use super::report::write_page;
use indicatif::{ProgressBar, ProgressStyle};
use nertca_vk::config::Config;
use nertca_vk::error::{Error, Result};
use nertca_vk::formats::nrrd;
use nertca_vk::model::checkpoint::{self, newest_model};
use nertca_vk::plan::Plan;
use nertca_vk::run::events::Event;
use nertca_vk::run::info::RunInfo;
use nertca_vk::run::reconstruct::{RunOptions, reconstruct};
use nertca_vk::run::score::evaluate_model;
use nertca_vk::scan::dataset::Dataset;
use std::io::IsTerminal;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

fn config(args: &TrainArgs) -> Result<Config> {
    let iterations = args.iterations.map(|n| format!("train.iterations={n}"));
    args.config.load(iterations.into_iter().chain(args.seed.map(|s| format!("seed={s}"))))
}

/// Trains.
pub fn run(cli: &Cli, args: &TrainArgs) -> Result<()> {
    let config = config(args)?;
    if args.print_config {
        out!("{}", config.to_toml()?.trim_end());
        return Ok(());
    }
    let (Some(data), Some(run)) = (&args.data, &args.out) else {
        return Err(Error::Internal("clap lets no run without DATA and --out pass".into()));
    };
    let dataset = Dataset::open(data)?;
    if let Some(file) = &args.export_hull {
        return export_hull(&config, &dataset, file);
    }
    prepare_directory(run, args)?;
    let cancel = Arc::new(AtomicBool::new(false));
    let seen = cancel.clone();
    ctrlc::set_handler(move || {
        if seen.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
    })
    .map_err(|e| Error::Internal(format!("Ctrl-C handler: {e}")))?;
    let gpu = cli.open_device()?;
    RunInfo { dataset: dataset.path.canonicalize().unwrap_or_else(|_| dataset.path.clone()) }.write(run)?;
    // A resumed run keeps its own configuration, so that is what paths are chosen for.
    let config = if args.resume { newest_model(run)?.config } else { config };
    let tuning = cli.training_tuning(&gpu, &config, &dataset)?;
    let options = RunOptions { tuning: &tuning, run, resume: args.resume, stop_at: args.stop_at, cancel: &cancel };
    let mut observer: Box<dyn FnMut(&Event)> = if args.json { Box::new(print_json) } else { Box::new(show_progress()) };
    let outcome = reconstruct(&gpu, &config, &dataset, &options, &mut observer);
    drop(observer);
    outcome?;
    let report = run.join("report");
    let (model, page) = (newest_model(run)?, run.join("report.html"));
    if dataset.validation().is_empty() {
        write_page(&gpu, &tuning, &model, &dataset, None, (run, &report), &page)?;
    } else {
        let evaluation = evaluate_model(&gpu, &tuning, &model, &dataset, None, Some(&report))?;
        write_page(&gpu, &tuning, &model, &dataset, Some(&evaluation), (run, &report), &page)?;
        let text = nertca_vk::files::pretty_json(&evaluation)?;
        nertca_vk::files::write_atomic(&report.join("evaluation.json"), text.as_bytes())?;
        if !args.json {
            print_table(&evaluation);
            out!("report: {}, pictures: {}", page.display(), report.display());
        }
    }
    cli.close_device(&gpu)
}

fn prepare_directory(run: &Path, args: &TrainArgs) -> Result<()> {
    if args.resume || !run.exists() {
        return Ok(());
    }
    let old = checkpoint::list(run)?;
    if old.is_empty() {
        return Ok(());
    }
    if !args.force {
        return Err(Error::config(
            "--out",
            run.display(),
            "already holds a run: continue it with --resume, or start over with --force",
        ));
    }
    for (_, path) in old {
        std::fs::remove_file(&path).map_err(Error::io("remove", &path))?;
    }
    Ok(())
}

fn export_hull(config: &Config, dataset: &Dataset, file: &Path) -> Result<()> {
    let plan = Plan::new(config, dataset)?;
    plan.notes.iter().for_each(|note| eprintln!("{note}"));
    let hull = plan.hull.ok_or_else(|| Error::config("hull", "", "this configuration and dataset give no hull"))?;
    nrrd::write(file, &hull.to_volume(), "phases at which a cell may move")
}

fn print_json(event: &Event) {
    if let Ok(line) = serde_json::to_string(event) {
        out!("{line}");
    }
}

fn show_progress() -> impl FnMut(&Event) {
    let terminal = std::io::stderr().is_terminal();
    let bar = ProgressBar::new(1);
    if let Ok(style) = ProgressStyle::with_template("[{bar:30}] {pos}/{len} {msg}") {
        bar.set_style(style);
    }
    let say = move |bar: &ProgressBar, text: String| {
        if terminal { bar.println(text) } else { eprintln!("{text}") }
    };
    move |event| match event {
        Event::Started { device, step, iterations, parameters, notes } => {
            bar.set_length(u64::from(*iterations));
            bar.set_position(u64::from(*step));
            say(&bar, format!("{device}: {parameters} parameters"));
            notes.iter().for_each(|n| say(&bar, format!("- {n}")));
        }
        Event::Progress { loss, psnr, iterations_per_s, left_s, .. } => {
            bar.set_position(u64::from(loss.step));
            bar.set_message(format!(
                "loss {:.3e}  PSNR {psnr:.1} dB  {iterations_per_s:.1} it/s  {left_s:.0} s left",
                loss.total()
            ));
        }
        Event::Validation { step, train_s, dice_dynamic, psnr, ssim, .. } => {
            let dice = dice_dynamic.map_or("-".into(), |d| format!("{d:.3}"));
            say(&bar, format!("{step:6} iterations, {train_s:6.1} s: Dice {dice}  PSNR {psnr:.2} dB  SSIM {ssim:.3}"));
        }
        Event::Profile { .. } => (),
        Event::Saved { path, .. } => bar.set_message(format!("saved {}", path.display())),
        Event::Finished { step, train_s, .. } => {
            bar.finish_and_clear();
            say(&bar, format!("{step} iterations in {train_s:.1} s of training"));
        }
    }
}
