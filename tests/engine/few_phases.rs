//! The soft hull where a beat has few phases: a vessel may be anywhere, or not filled, at the phases before and after.

use crate::check::{Flaws, angiograms_at, blobs};
use nertca_vk::config::{Config, Preset};
use nertca_vk::methods::dynamic_gaussians::soft_hull::carve::{SoftHull, SoftMotion};
use nertca_vk::plan::Plan;
use nertca_vk::scan::dataset::Dataset;
use std::collections::HashSet;

const RESOLUTION: usize = 96;
/// Half side of the box, world units: about half the field of view at the isocentre.
const HALF: f64 = 0.6;
/// The thicker part of the vessel, which stands out of the noise.
const THICK: usize = 80;

/// Share of the centres of the vessel's thicker blobs whose cells are kept at a phase.
fn found(hull: &SoftHull, phase: usize, seed: u32, moment: f64) -> f64 {
    let kept: HashSet<u32> = hull.cells[phase].iter().map(|c| c.index).collect();
    let n = hull.resolution as f64;
    let of_vessel = blobs(seed, moment);
    let inside = of_vessel[..THICK].iter().filter(|(centre, _)| {
        let cell = ((*centre - hull.min) / hull.cell).floor();
        kept.contains(&(((cell.z * n + cell.y) * n + cell.x) as u32))
    });
    inside.count() as f64 / THICK as f64
}

/// Vessel at rest, vessel contracted, and no vessel.
const REST: Option<f64> = Some(0.0);
const SYSTOLE: Option<f64> = Some(0.3);
const NONE: Option<f64> = None;

#[test]
fn vessels_of_beats_with_two_and_three_phases_are_kept() {
    let beats: [&[Option<f64>]; 5] =
        [&[REST, NONE], &[REST, SYSTOLE], &[REST, REST, NONE], &[REST, NONE, NONE], &[REST, SYSTOLE, NONE]];
    let mut failures = Vec::new();
    for n_views in [2, 3, 4] {
        // The strongest vessel has a line integral of about .5.
        for noise in [0.0, 0.005, 0.015] {
            for beat in beats {
                let flaws = Flaws { seed: 1, noise, ..Flaws::default() };
                let dataset = angiograms_at(n_views, flaws, beat);
                let hull = SoftMotion::new(&dataset, HALF, RESOLUTION).hull;
                let moments = beat.iter().enumerate().filter_map(|(phase, moment)| Some((phase, (*moment)?)));
                let recall = moments.map(|(phase, moment)| found(&hull, phase, 1, moment)).fold(1.0, f64::min);
                let share = 100.0 * hull.share();
                let line = format!("{n_views} views, noise {noise}, {beat:?}: found {recall:.2}, box {share:.3} %");
                println!("{line}");
                if recall < 0.85 || share > 1.5 {
                    failures.push(line);
                }
            }
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

#[test]
fn noise_in_few_phases_leaves_next_to_nothing() {
    for n_views in [2, 3, 4] {
        for n_phases in [2, 3] {
            let flaws = Flaws { seed: 1, noise: 0.02, ..Flaws::default() };
            let hull = SoftMotion::new(&angiograms_at(n_views, flaws, &vec![NONE; n_phases]), HALF, RESOLUTION).hull;
            println!("{n_views} views, {n_phases} phases: {:.4} %", 100.0 * hull.share());
            assert!(hull.share() < 0.01, "{n_views} views, {n_phases} phases: {}", hull.share());
        }
    }
}

fn plan(dataset: &Dataset) -> Result<f64, String> {
    let plan = Plan::new(&Config::preset(Preset::Fast), dataset).map_err(|e| e.to_string())?;
    Ok(plan.hull.map_or(0.0, |hull| hull.share()))
}

#[test]
fn the_preset_fast_takes_two_phases_and_refuses_one() {
    let of = |beat: &[Option<f64>]| plan(&angiograms_at(4, Flaws { seed: 1, ..Flaws::default() }, beat));
    assert!(of(&[REST, NONE]).is_ok_and(|share| share > 0.0));
    assert!(of(&[REST, NONE, NONE]).is_ok_and(|share| share > 0.0));
    let refusal = of(&[REST]).unwrap_err();
    assert!(refusal.contains("no training view has two phases"), "{refusal}");
}
