//! The command `check`.

use clap::Args;
use nertca_vk::calibrate::calibrate;
use nertca_vk::calibrate::choose::Correction;
use nertca_vk::check::{Check, check};
use nertca_vk::config::{Config, Preset};
use nertca_vk::error::{Error, Result};
use nertca_vk::files;
use nertca_vk::plan::Plan;
use nertca_vk::scan::dataset::Dataset;
use nertca_vk_runs::run::hull_pictures;
use std::path::PathBuf;

/// Arguments of `check`.
#[derive(Debug, Args)]
pub struct CheckArgs {
    /// Dataset directory.
    pub data: PathBuf,
    /// Print JSON instead of text.
    #[arg(long)]
    pub json: bool,
    /// Write a picture of each training view to this directory, with the region on which all views agree in orange.
    #[arg(long, value_name = "DIR")]
    pub pictures: Option<PathBuf>,
}

/// Checks a dataset and prints the findings.
pub fn run(args: &CheckArgs) -> Result<()> {
    let dataset = Dataset::open(&args.data)?;
    let found = check(&dataset)?;
    if args.json {
        out!("{}", files::pretty_json(&found)?);
    } else {
        print(&dataset, &found)?;
    }
    if let Some(directory) = &args.pictures {
        match Plan::new(&Config::preset(Preset::default()), &dataset)?.hull {
            Some(hull) => hull_pictures::write(directory, &dataset, &hull)?,
            None => eprintln!("no pictures were written: no motion is consistent between the views"),
        }
    }
    if !found.faulty() {
        return Ok(());
    }
    Err(Error::data(&dataset.path, "dataset", found.conclusion()))
}

fn print(dataset: &Dataset, found: &Check) -> Result<()> {
    out!("view primary secondary phases    noise  at the edge  wide motion");
    for v in &found.views {
        let angle = |deg: Option<f64>| deg.map_or("-".into(), |deg| format!("{deg:.1}"));
        let (primary, secondary) = (angle(v.angles_deg.map(|a| a.0)), angle(v.angles_deg.map(|a| a.1)));
        let noise = v.noise.map_or("-".into(), |noise| format!("{:.1}%", 100.0 * noise));
        let edge = 100.0 * v.at_edges;
        let wide = v.wide_motion.map_or("-".into(), |size| format!("{:.1}%", 100.0 * size));
        out!("{:4} {primary:>7} {secondary:>9} {:6} {noise:>8} {edge:11.1}% {wide:>12}", v.view, v.phases);
    }
    if let Some(agreement) = &found.agreement {
        out!("disagreement of the views (0: the same object, 100: unrelated images): {:.1}", 100.0 * agreement.fine);
        for pair in &agreement.pairs {
            let [a, b] = pair.views.map(|v| found.views[v].view);
            let note = if pair.judged { "" } else { " (too little evidence to count)" };
            out!("  views {a} and {b}: {:.1}{note}", 100.0 * pair.residual);
        }
    }
    found.in_numbers().iter().for_each(|numbers| out!("{numbers}"));
    found.missing.iter().for_each(|missing| out!("missing evidence: {missing}"));
    match found.mistakes.as_slice() {
        [] => (),
        [one] => out!("mistake: {one}"),
        several => {
            out!("one of these mistakes was made:");
            several.iter().for_each(|m| out!("  - {m}"));
        }
    }
    found.warnings.iter().for_each(|w| out!("warning: {w}"));
    if !found.faulty() {
        let config = Config::preset(Preset::default());
        let calibration = calibrate(dataset, config.calibration())?;
        calibration.notes.iter().for_each(|note| out!("{note}"));
        let [_, by_chance] = found.explained;
        let explained = match calibration.correction {
            Correction::Stated => found.explained,
            _ => [calibration.explained[1], calibration.explained_by_chance.unwrap_or(by_chance)],
        };
        out!("{}", Check { explained, ..found.clone() }.conclusion());
    }
    Ok(())
}
