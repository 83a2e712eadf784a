//! The command `eval`.

use crate::args::options::GlobalOptions;
use crate::command::tree::{of_page as tree_of_page, score as score_tree_of_page};
use crate::output::Earlier;
use crate::pages::report::Report;
use crate::pages::tree_table;
use crate::pages::volume_table;
use crate::progress::{show_evaluation, stop_flag};
use clap::Args;
use nertca_vk::checkpoint::newest_model;
use nertca_vk::error::{Error, Result};
use nertca_vk::files::pretty_json;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk_runs::run::info::RunInfo;
use nertca_vk_runs::run::score::{ScoreOptions, as_trained, evaluate_model};
use nertca_vk_vessels::score::ceiling::truth_dice;
use nertca_vk_vessels::score::dice::BestDice;
use nertca_vk_vessels::score::eval::{BestDices, Evaluation};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Arguments of `eval`.
#[derive(Debug, Args)]
pub struct EvalArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Dataset with validation frames; by default the one that the run was trained on.
    #[arg(long, value_name = "DATA")]
    pub data: Option<PathBuf>,
    /// Print JSON instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Write comparison pictures and `report.html` to this directory; without it, a page without pictures is written to RUN as
    /// `eval.html`.
    #[arg(long, value_name = "DIR")]
    pub images: Option<PathBuf>,
    /// Replace the page and the pictures of an earlier evaluation in the directory of --images.
    #[arg(short, long, requires = "images")]
    pub force: bool,
    /// Also find the vessels as a tree (takes seconds): shown over the angiograms on the page, with lengths and diameters, and
    /// written as `tree.json` beside it.
    #[arg(long)]
    pub tree: bool,
    /// Also score the true vessels by the same rule, where the dataset has their volumes: the scores of a perfect field.
    #[arg(long)]
    pub ceiling: bool,
    /// Dice threshold on attenuation, 1/mm, instead of the automatic one.
    #[arg(long, value_name = "PER_MM")]
    pub threshold: Option<f64>,
}

/// Scores a run.
pub fn eval(global: &GlobalOptions, args: &EvalArgs) -> Result<()> {
    let data = match &args.data {
        Some(path) => path.clone(),
        None => RunInfo::read(&args.run)?.dataset,
    };
    if args.threshold.is_some_and(|t| !(t.is_finite() && t >= 0.0)) {
        return Err(Error::config("--threshold", args.threshold.unwrap_or_default(), "is negative"));
    }
    let earlier = match &args.images {
        Some(directory) => Earlier::pictures(directory, args.force)?,
        None => Earlier::none(),
    };
    let dataset = as_trained(Dataset::open(&data)?, &args.run)?;
    let gpu = global.open_device()?;
    let model = newest_model(&args.run)?;
    let tuning = global.tuning(&gpu, &model.config);
    let cancel = stop_flag()?;
    earlier.make_way(&[])?;
    let scoring = ScoreOptions { threshold_per_mm: args.threshold, pictures: args.images.as_deref(), cancel: &cancel };
    let mut evaluation = evaluate_model(&gpu, &tuning, &model, &dataset, &scoring, &mut show_evaluation())?;
    if args.ceiling {
        add_ceiling(&data, &mut evaluation, &cancel)?;
    }
    let run = if args.run.is_dir() { args.run.as_path() } else { args.run.parent().unwrap_or(Path::new("")) };
    let (pictures, page) = match &args.images {
        Some(images) => (images.as_path(), images.join("report.html")),
        None => (Path::new(""), run.join("eval.html")),
    };
    let beside = page.parent().unwrap_or(Path::new(""));
    let warnings = &mut evaluation.warnings;
    let found = if args.tree {
        tree_of_page(global, (&gpu, &model), (run, &dataset), &cancel, beside, warnings)
    } else {
        Ok(None)
    };
    // If the tree fails or is stopped, the scores are still printed.
    let tree = found.or_else(|error| print_scores(args, &evaluation).and(Err(error)))?;
    score_tree_of_page(tree.as_ref(), &dataset, &mut evaluation)?;
    Report {
        gpu: &gpu,
        tuning: &tuning,
        model: &model,
        dataset: &dataset,
        evaluation: Some(&evaluation),
        warnings: &evaluation.warnings,
        tree: tree.as_ref(),
        run,
        pictures,
    }
    .write(&page)?;
    print_scores(args, &evaluation)?;
    evaluation.warnings.iter().for_each(|warning| eprintln!("warning: {warning}"));
    global.close_device(&gpu)
}

/// Scores the true vessels of a dataset as the model was scored, with the geometry that the dataset states.
fn add_ceiling(data: &Path, evaluation: &mut Evaluation, cancel: &AtomicBool) -> Result<()> {
    let proceed = || if cancel.load(Ordering::Relaxed) { Err(Error::Interrupted) } else { Ok(()) };
    let found = truth_dice(&Dataset::open(data)?, evaluation.threshold.dynamic_per_mm, proceed);
    let without = match found {
        // The truth is faulty: the model is scored nevertheless.
        Err(error @ (Error::Data { .. } | Error::Io { .. })) => Some(error.to_string()),
        Ok(None) => Some(format!(
            "no unseen image of {} has both a mask and a true volume (volumes/) of its phase",
            data.display()
        )),
        found => {
            evaluation.ceiling = found?;
            None
        }
    };
    evaluation.warnings.extend(without.map(|why| format!("The true vessels are not scored: {why}.")));
    Ok(())
}

fn print_scores(args: &EvalArgs, evaluation: &Evaluation) -> Result<()> {
    if args.json {
        out!("{}", pretty_json(evaluation)?);
    } else {
        print_table(evaluation);
    }
    Ok(())
}

/// Prints scores as a table with means.
pub fn print_table(evaluation: &Evaluation) {
    let dice = |d: Option<f64>| d.map_or("    -".into(), |d| format!("{d:.3}"));
    let angle = |a: Option<f64>| a.map_or("    -".into(), |a| format!("{a:5.0}"));
    out!("primary secondary phase  Dice dynamic  Dice total   PSNR dB   SSIM");
    for i in &evaluation.images {
        out!(
            "{}   {}     {:3}         {}       {}    {:6.2}  {:.3}",
            angle(i.primary_deg),
            angle(i.secondary_deg),
            i.phase,
            dice(i.dice_dynamic),
            dice(i.dice_total),
            i.psnr,
            i.ssim
        );
    }
    out!(
        "mean of {:3} images          {}       {}    {:6.2}  {:.3}",
        evaluation.images.len(),
        dice(evaluation.dice.dynamic),
        dice(evaluation.dice.total),
        evaluation.psnr,
        evaluation.ssim
    );
    if let Some(stated) = &evaluation.dice_as_stated {
        out!(
            "the unseen views are scored in the frame of the calibrated reconstruction; with the stated geometry, Dice \
             is {} / {}",
            dice(stated.dynamic),
            dice(stated.total)
        );
    }
    out!(
        "Dice threshold {:.4e} / {:.4e} per mm (dynamic / total): {}",
        evaluation.threshold.dynamic_per_mm,
        evaluation.threshold.total_per_mm,
        evaluation.threshold.rule
    );
    let best = |best: Option<BestDice>| match best {
        Some(best) => format!("{:.3} at {:.4e} per mm", best.dice, best.threshold_per_mm),
        None => "-".into(),
    };
    let BestDices { dynamic, total } = evaluation.best_dice;
    out!("best Dice of all thresholds, which needs the masks: {} / {}", best(dynamic), best(total));
    if let Some(ceiling) = evaluation.ceiling {
        out!(
            "Dice of the true vessels by the same rule: {:.3}; best of all thresholds: {}",
            ceiling.dice,
            best(ceiling.best)
        );
    }
    if let Some(otsu) = evaluation.dice_otsu {
        out!("Dice at Otsu's threshold of each image: {otsu:.3}");
    }
    let published = evaluation.dice_published;
    out!(
        "Dice at the authors' threshold, {:.4e} per mm: {} (dynamic, as in the paper) / {} (total, first image, as in their code)",
        published.threshold_per_mm,
        dice(published.paper),
        dice(published.authors)
    );
    if let Some(volume) = &evaluation.volume {
        volume_table::table(volume).print();
    }
    if let Some(tree) = &evaluation.tree {
        tree_table::table(tree).print();
        if let Some(text) = tree.lesions.as_ref().and_then(tree_table::lesions_in_words) {
            out!("{text}");
        }
    }
}
