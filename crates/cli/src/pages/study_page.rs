//! The page of a study: its table, Dice over the time of training, and pictures side by side. It is self-contained; the plots of Dice
//! are written beside it as well.

use crate::pages::page::{DISTANCE_TITLE, STYLE, embedded};
use crate::pages::plot::{Line, plot};
use maud::{DOCTYPE, Markup, PreEscaped, html};
use nertca_vk::error::Result;
use nertca_vk::files;
use nertca_vk_study::data::DataSet;
use nertca_vk_study::outcome::{CurvePoint, Outcome, Results, run_directory};
use nertca_vk_study::plan::{Run, Study};
use nertca_vk_study::scores::Score;
use nertca_vk_study::table::{Cell, Table};
use nertca_vk_study::work::picture_file;
use plotters::style::RGBColor;
use std::path::Path;

/// Colours of methods, distinguishable with colour vision deficiencies (Okabe and Ito 2008).
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    RGBColor(0, 0, 0),
];

/// A run and its outcome.
struct Finished {
    run: Run,
    outcome: Outcome,
}

/// Name of the page in the directory of a study.
const PAGE: &str = "report.html";

/// Writes the page and one plot of Dice for each data set; returns the names of these files.
///
/// # Errors
/// Errors of results and pictures that cannot be read, and of writing.
pub fn write(study: &Study, directory: &Path) -> Result<Vec<String>> {
    let table = Table::gather(study, directory)?;
    let finished = finished(study, directory)?;
    let mut written = vec![PAGE.to_owned()];
    let sections = (0..study.data.len())
        .map(|data| {
            let of_data: Vec<&Finished> = finished.iter().filter(|f| f.run.data == data).collect();
            let plots = curves(study, &of_data)?;
            if !plots[0].is_empty() {
                let name = format!("dice-{}.svg", study.data[data].id);
                files::write_atomic(&directory.join(&name), plots[0].as_bytes())?;
                written.push(name);
            }
            Ok(html! {
                @if !of_data.is_empty() {
                    h2 { (heading(&study.data[data])) }
                    p.lead { "Curves are of some unseen images, single dots of all of them at the end of a run." }
                    @for svg in &plots { @if !svg.is_empty() { div.plot { (PreEscaped(svg)) } } }
                    (pictures(study, directory, &of_data)?)
                }
            })
        })
        .collect::<Result<Vec<Markup>>>()?;
    let text = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width";
                title { (study.title) " - nertca-vk" }
                style { (PreEscaped(STYLE)) }
            }
            body {
                h1 { (study.title) }
                p.lead { "A study with nertca-vk " (env!("CARGO_PKG_VERSION")) }
                (rows(&table))
                @for note in &table.notes { p.lead { (note) } }
                @for section in &sections { (section) }
            }
        }
    };
    files::write_atomic(&directory.join(PAGE), text.into_string().as_bytes())?;
    Ok(written)
}

/// Returns the name of a data set and its number of views.
fn heading(set: &DataSet) -> String {
    set.views.map_or_else(|| set.label.clone(), |views| format!("{}, {views} views", set.label))
}

/// Returns the runs that have a result for the study's current inputs.
fn finished(study: &Study, directory: &Path) -> Result<Vec<Finished>> {
    let (results, mut finished) = (Results::open(directory)?, Vec::new());
    for run in study.runs() {
        if let Some(outcome) = results.of(study, &run, true)? {
            finished.push(Finished { run, outcome });
        }
    }
    Ok(finished)
}

fn rows(table: &Table) -> Markup {
    let grid = table.grid();
    let text = |score, cell: &Cell| html! { @if cell.best { b { (cell.plain(score)) } } @else { (cell.plain(score)) } };
    html! {
        div style="overflow-x:auto" { table style="white-space:nowrap" {
            tr {
                @for heading in &grid.headings { th { (heading) } }
                @for (group, score) in &grid.columns { th { @if !group.is_empty() { (group) br; } (score.heading()) } }
            }
            @for (names, cells) in &grid.rows {
                tr {
                    @for name in names { td { (name) } }
                    @for ((_, score), cell) in grid.columns.iter().zip(cells) {
                        td { @if let Some(cell) = cell { (text(*score, cell)) } }
                    }
                }
            }
        } }
    }
}

/// Plots Dice, and distances to true vessels, over the time of training, as SVG; empty where no run was validated during training.
fn curves(study: &Study, finished: &[&Finished]) -> Result<[String; 2]> {
    let Some(Finished { run, .. }) = finished.first() else { return Ok([String::new(), String::new()]) };
    let set = &study.data[run.data];
    let mut dice = lines(study, finished, |point| point.dice, Score::Dice);
    if !dice.is_empty() {
        dice.extend(published_ends(study, set));
    }
    let distances = lines(study, finished, |point| point.chamfer_mm, Score::ChamferMm);
    let title = format!("{}: Dice of the dynamic field", heading(set));
    Ok([plot(&title, &dice, false)?, plot(DISTANCE_TITLE, &distances, false)?])
}

/// Makes one line per run, with one colour per method, and a single dot where only the final score is known. Names include the device
/// where runs have several.
fn lines(study: &Study, finished: &[&Finished], pick: fn(&CurvePoint) -> Option<f64>, at_end: Score) -> Vec<Line> {
    let mut lines: Vec<Line> = Vec::new();
    let one_device = finished.windows(2).all(|pair| pair[0].outcome.device == pair[1].outcome.device);
    for Finished { run, outcome } in finished {
        let mut points: Vec<(f64, f64)> = outcome.curve.iter().filter_map(|p| Some((p.train_s, pick(p)?))).collect();
        let end = outcome.score(at_end);
        match end {
            Some(end) if points.is_empty() => points.push((outcome.seconds.training, end)),
            None if points.is_empty() => continue,
            _ => {}
        }
        let label = &study.methods[run.method].label;
        // Drivers add versions and widths in brackets.
        let device = outcome.device.split(" (").next().unwrap_or_default();
        let label = if one_device { label.clone() } else { format!("{label}, {device}") };
        let name = if lines.iter().any(|line| line.name == label) { String::new() } else { label };
        lines.push(Line { name, colour: COLOURS[run.method % COLOURS.len()], points, published: false });
    }
    lines
}

/// Returns the final points of published runs on a data set, as far as they are known, in the colour of the study's own runs of the
/// method.
fn published_ends(study: &Study, set: &DataSet) -> Vec<Line> {
    let Some(published) = &study.published else { return Vec::new() };
    let end = |(index, method): (usize, &str)| {
        let value = |score| published.value(method, &set.name, set.views, score);
        let points = vec![(60.0 * value(Score::Minutes)?, value(Score::Dice)?)];
        let ours = study.methods.iter().position(|m| m.published.as_deref() == Some(method));
        let colour = COLOURS[ours.unwrap_or(study.methods.len() + index) % COLOURS.len()];
        Some(Line { name: format!("{method}, as published"), colour, points, published: true })
    };
    published.methods().into_iter().enumerate().filter_map(end).collect()
}

/// Shows the first unseen image of each method's first run.
fn pictures(study: &Study, directory: &Path, finished: &[&Finished]) -> Result<Markup> {
    let mut figures = Vec::new();
    for (method, m) in study.methods.iter().enumerate() {
        let runs = finished.iter().filter(|f| f.run.method == method);
        let mut files = runs.map(|f| (f.run.seed, picture_file(&run_directory(directory, &f.run))));
        if let Some((seed, file)) = files.find(|(_, file)| file.is_file()) {
            figures.push((&m.label, seed, embedded(&file)?));
        }
    }
    Ok(html! {
        @if !figures.is_empty() {
            p.lead { "First unseen image: truth, prediction, static field, dynamic field, vessel overlap (green found, red missed, blue added)." }
            div.by-view {
                @for (label, seed, data) in &figures {
                    figure { img alt=(format!("{label}, seed {seed}")) src=(data); figcaption { (label) ", seed " (seed) } }
                }
            }
        }
    })
}
