//! `next`: the view to take next.

use crate::args::options::GlobalOptions;
use crate::command::tree::{found_in_phases, measure_in_run};
use crate::pages::lettering;
use clap::Args;
use image::{DynamicImage, Rgb, RgbImage};
use nertca_vk::checkpoint::newest_model;
use nertca_vk::error::Result;
use nertca_vk::files::pretty_json;
use nertca_vk::formats::png;
use nertca_vk::geometry::CArm;
use nertca_vk_vessels::trees::next_view::{ArmLimits, Candidate, Subject, best, candidates, decisive_phases};
use nertca_vk_vessels::trees::tree::{BeatTree, PhaseTree, TreeView};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Default number of suggestions.
pub const SUGGESTIONS: usize = 3;
/// Angle between suggestions, degrees.
const APART_DEG: f64 = 20.0;

/// Arguments of `next`.
#[derive(Debug, Args)]
pub struct NextArgs {
    /// Run directory or checkpoint file.
    pub run: PathBuf,
    /// Look for the best sight of one branch, by its number in `tree`, instead of the best view for the whole tree.
    #[arg(long, value_name = "N")]
    pub branch: Option<usize>,
    /// Limits of the primary angle, degrees; LAO is positive.
    #[arg(
        long,
        value_name = "LOW,HIGH",
        default_value = "-90,90",
        value_delimiter = ',',
        num_args = 1,
        allow_hyphen_values = true
    )]
    pub primary: Vec<f64>,
    /// Limits of the secondary angle, degrees; cranial is positive.
    #[arg(
        long,
        value_name = "LOW,HIGH",
        default_value = "-40,40",
        value_delimiter = ',',
        num_args = 1,
        allow_hyphen_values = true
    )]
    pub secondary: Vec<f64>,
    /// Step between positions, degrees.
    #[arg(long, value_name = "DEG", default_value_t = 5.0)]
    pub step: f64,
    /// Number of suggestions, at least 20 degrees apart.
    #[arg(long, value_name = "N", default_value_t = SUGGESTIONS)]
    pub count: usize,
    /// Print JSON with all positions instead of a table.
    #[arg(long)]
    pub json: bool,
    /// Also write a map of the positions: dark is good, training views are black, suggestions are red.
    #[arg(short, long, value_name = "FILE.png")]
    pub out: Option<PathBuf>,
}

/// Positions of the C-arm for the next view, as the command prints them in JSON.
#[derive(Serialize)]
pub struct Plan {
    format: &'static str,
    version: u32,
    branch: Option<usize>,
    suggested: Vec<Candidate>,
    positions: Vec<Candidate>,
}

impl Plan {
    /// Plans the next view of a tree, with a C-arm whose images have so many columns and rows: all vessels count, or one branch.
    ///
    /// # Errors
    /// Errors of [`candidates`].
    pub fn new(
        beat: &BeatTree,
        (c_arm, image_size): (&CArm, [usize; 2]),
        branch: Option<usize>,
        limits: &ArmLimits,
        count: usize,
    ) -> Result<Plan> {
        let is_followed = beat.reference_phase.is_some();
        let decisive = decisive_phases(beat.phases.len() as u32);
        let counts = |(index, tree): (usize, &PhaseTree)| {
            // Where points are not followed, the command finds the decisive phases alone.
            let counts = index == 0 || is_followed && (beat.phases.len() <= 2 || decisive.contains(&tree.phase));
            counts.then(|| tree.clone())
        };
        let phases: Vec<PhaseTree> = beat.phases.iter().enumerate().filter_map(counts).collect();
        let (resolution_mm, views) = (beat.resolution_mm, beat.views.as_slice());
        let subject = Subject { phases: &phases, resolution_mm, views, branch, c_arm, image_size };
        let positions = candidates(&subject, limits)?;
        let suggested = best(&positions, count, APART_DEG);
        Ok(Plan { format: "nertca-next-view", version: 1, branch, suggested, positions })
    }
}

/// Suggests the view to take next.
pub fn run(global: &GlobalOptions, args: &NextArgs) -> Result<()> {
    let limits = ArmLimits {
        primary_deg: range("--primary", &args.primary)?,
        secondary_deg: range("--secondary", &args.secondary)?,
        step_deg: args.step,
    };
    let model = newest_model(&args.run)?;
    let gpu = global.open_device()?;
    let mut beat = found_in_phases(global, &gpu, &model, decisive_phases(model.shown_phases()))?;
    measure_in_run(&mut beat, &args.run, "the training views do not count");
    let plan = Plan::new(&beat, (&model.c_arm, model.image_size), args.branch, &limits, args.count)?;
    if let Some(file) = &args.out {
        write_map(&plan, &beat.views, file)?;
    }
    if args.json {
        out!("{}", pretty_json(&plan)?);
    } else {
        plan.suggested.iter().for_each(|candidate| out!("{}", in_words(candidate)));
    }
    global.close_device(&gpu)
}

/// Returns the two numbers of a range.
fn range(name: &str, values: &[f64]) -> Result<[f64; 2]> {
    values.try_into().map_err(|_| {
        nertca_vk::error::Error::config(name, format!("{values:?}"), "is not a range LOW,HIGH, such as -90,90")
    })
}

fn angles(primary_deg: f64, secondary_deg: f64) -> String {
    let angle =
        |value: f64, plus: &str, minus: &str| format!("{} {:.0}", if value >= 0.0 { plus } else { minus }, value.abs());
    format!("{}, {}", angle(primary_deg, "LAO", "RAO"), angle(secondary_deg, "CRA", "CAU"))
}

/// Describes a position in a line.
fn in_words(candidate: &Candidate) -> String {
    let percent = |share: f64| format!("{:.0} %", 100.0 * share);
    let doubtful = candidate
        .doubtful_overlap
        .map_or(String::new(), |share| format!(", of what fits disagree about {}", percent(share)));
    let nearest = candidate
        .nearest_view_deg
        .map_or(String::new(), |deg| format!("; {deg:.0} degrees from the nearest training view"));
    let removed = candidate
        .doubt_removed
        .map_or(String::new(), |share| format!("; the view removes {} of the doubt about places", percent(share)));
    format!(
        "{}: other vessels touch {} of the length{doubtful}; {} are lost to foreshortening, {} lie outside the image{removed}{nearest}",
        angles(candidate.primary_deg, candidate.secondary_deg),
        percent(candidate.overlap),
        percent(candidate.foreshortening),
        percent(candidate.outside)
    )
}

/// Pixels of the map per position.
const CELL: u32 = 16;
/// Space around the map, pixels.
const MARGIN: u32 = 64;
/// Interval of the angles that are written beside the map, degrees.
const MARK_DEG: f64 = 30.0;
/// Half the side of a mark, pixels.
const MARK: i64 = 5;
const INK: Rgb<u8> = Rgb([20, 20, 24]);
const RED: Rgb<u8> = Rgb([214, 30, 40]);

/// Writes the map of the positions, RAO at the left and cranial at the top.
fn write_map(plan: &Plan, views: &[TreeView], file: &Path) -> Result<()> {
    Ok(png::write(file, &DynamicImage::ImageRgb8(map(&plan.positions, &plan.suggested, views)))?)
}

fn map(positions: &[Candidate], suggested: &[Candidate], views: &[TreeView]) -> RgbImage {
    let columns = positions.chunk_by(|a, b| a.secondary_deg == b.secondary_deg).next().map_or(1, <[Candidate]>::len);
    let rows = positions.len() / columns;
    let size = [columns, rows].map(|n| n as u32 * CELL + 2 * MARGIN);
    let mut picture = RgbImage::from_pixel(size[0], size[1], Rgb([255, 255, 255]));
    let costs = || positions.iter().map(|candidate| candidate.cost);
    let (low, high) = (costs().fold(f64::INFINITY, f64::min), costs().fold(f64::NEG_INFINITY, f64::max));
    for (index, candidate) in positions.iter().enumerate() {
        let share = (candidate.cost - low) / (high - low).max(f64::MIN_POSITIVE);
        let colour = Rgb([(60.0 + 190.0 * share) as u8, (110.0 + 135.0 * share) as u8, (150.0 + 90.0 * share) as u8]);
        let (column, row) = ((index % columns) as u32, (rows - 1 - index / columns) as u32);
        for (x, y) in (0..CELL).flat_map(|y| (0..CELL).map(move |x| (x, y))) {
            picture.put_pixel(MARGIN + column * CELL + x, MARGIN + row * CELL + y, colour);
        }
    }
    let Some(first) = positions.first() else { return picture };
    let step_deg = if columns > 1 { positions[1].primary_deg - first.primary_deg } else { MARK_DEG };
    let place = |primary_deg: f64, secondary_deg: f64| {
        let cell = |deg: f64| (deg / step_deg + 0.5) * f64::from(CELL);
        let x = f64::from(MARGIN) + cell(primary_deg - first.primary_deg);
        let y = f64::from(size[1] - MARGIN) - cell(secondary_deg - first.secondary_deg);
        (x.round() as i64, y.round() as i64)
    };
    let mut mark = |(x, y): (i64, i64), colour: Rgb<u8>| {
        for (dx, dy) in (-MARK..=MARK).flat_map(|dy| (-MARK..=MARK).map(move |dx| (dx, dy))) {
            if let (Ok(x), Ok(y)) = (u32::try_from(x + dx), u32::try_from(y + dy))
                && let Some(pixel) = picture.get_pixel_mut_checked(x, y)
            {
                *pixel = colour;
            }
        }
    };
    views
        .iter()
        .filter_map(|view| view.angles_deg)
        .for_each(|(primary, secondary)| mark(place(primary, secondary), INK));
    suggested.iter().for_each(|candidate| mark(place(candidate.primary_deg, candidate.secondary_deg), RED));
    let last = positions[positions.len() - 1];
    let marks = |from: f64, to: f64| {
        let start = (from / MARK_DEG).ceil() * MARK_DEG;
        (0..).map(move |k| start + f64::from(k) * MARK_DEG).take_while(move |deg| *deg <= to)
    };
    for deg in marks(first.primary_deg, last.primary_deg) {
        let (x, _) = place(deg, first.secondary_deg);
        lettering::write(&mut picture, (x - 12, i64::from(size[1] - MARGIN) + 8), &format!("{deg:.0}"), INK);
    }
    for deg in marks(first.secondary_deg, last.secondary_deg) {
        let (_, y) = place(first.primary_deg, deg);
        lettering::write(&mut picture, (16, y - 7), &format!("{deg:.0}"), INK);
    }
    lettering::write(&mut picture, (i64::from(MARGIN), 16), "CRANIAL UP, LAO RIGHT; DARK IS GOOD", INK);
    picture
}

#[cfg(test)]
mod tests {
    use super::*;

    fn candidate(primary_deg: f64, secondary_deg: f64, cost: f64) -> Candidate {
        Candidate {
            primary_deg,
            secondary_deg,
            overlap: 0.25,
            doubtful_overlap: None,
            foreshortening: 0.1,
            outside: 0.0,
            doubt_removed: Some(0.4),
            nearest_view_deg: Some(31.0),
            cost,
        }
    }

    #[test]
    fn the_map_has_cranial_at_the_top_and_lao_at_the_right() {
        let positions: Vec<Candidate> = [-10.0, 0.0, 10.0]
            .iter()
            .flat_map(|s| {
                [-20.0, -10.0, 0.0, 10.0, 20.0]
                    .map(|p| candidate(p, *s, if (p, *s) == (20.0, 10.0) { 0.0 } else { 1.0 }))
            })
            .collect();
        let drawn = map(&positions, &[], &[]);
        let cell = |column: u32, row: u32| *drawn.get_pixel(MARGIN + column * CELL + 1, MARGIN + row * CELL + 1);
        assert_eq!(cell(4, 0), Rgb([60, 110, 150]), "the best position");
        assert_eq!(cell(0, 0), cell(4, 2));
        let marked = map(&positions, &[positions[14]], &[]);
        assert_eq!(*marked.get_pixel(MARGIN + 4 * CELL + CELL / 2, MARGIN + CELL / 2), RED);
    }

    #[test]
    fn a_position_is_told_in_degrees_of_the_c_arm() {
        let told = in_words(&candidate(-20.0, 15.0, 0.0));
        assert!(told.starts_with("RAO 20, CRA 15: other vessels touch 25 %"), "{told}");
        assert!(told.contains("removes 40 % of the doubt"), "{told}");
    }
}
