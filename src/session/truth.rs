//! True vessels that a caller knows, and scores of a session against them and against its frames for validation.

use crate::error::{Error, Result};
use crate::geometry::MM_PER_UNIT;
use crate::scan::gating::BeatTime;
use crate::score::eval::{Evaluation, evaluate, moving_field_warning};
use crate::score::trees::{self, TrueLine};
use crate::score::volume::{MOST_VOXELS, TrueVessels, pixel_mm, score_known};
use crate::session::{Session, lock};
use std::collections::BTreeMap;

/// True vessels, by phase.
#[derive(Default)]
pub(super) struct Known {
    volumes: BTreeMap<u32, TrueVessels>,
    trees: BTreeMap<u32, Vec<TrueLine>>,
}

impl Session {
    /// Sets which voxels are vessel at a phase, in place of an earlier statement; `None` removes it. [`Session::evaluate`] then
    /// has scores in 3D.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase that does not exist, or a grid that does not fit its voxels or has too many.
    pub fn set_true_vessels(&self, phase: u32, vessels: Option<TrueVessels>) -> Result<()> {
        self.check_phase(phase)?;
        let Some(vessels) = vessels else {
            lock(&self.known).volumes.remove(&phase);
            return Ok(());
        };
        vessels.grid.check()?;
        let voxels = vessels.grid.size.iter().map(|n| u64::from(*n)).product::<u64>();
        if voxels != vessels.inside.len() as u64 {
            let problem = format!("is not the number of voxels of this grid, {voxels}");
            return Err(Error::config("vessels", vessels.inside.len(), problem));
        }
        if voxels > MOST_VOXELS {
            return Err(Error::config(
                "vessels",
                voxels,
                format!("exceeds the maximum number of voxels, {MOST_VOXELS}"),
            ));
        }
        lock(&self.known).volumes.insert(phase, vessels);
        Ok(())
    }

    /// Sets the true centrelines and vessel widths at each phase, in place of an earlier statement. [`Session::evaluate`] then
    /// finds the vessels as trees and scores those; where a line is the same at all phases, point i of it must be the same
    /// material point.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase that does not exist, where phase 0 is missing or phases differ in their lines, and for
    /// invalid lines.
    pub fn set_true_trees(&self, trees: BTreeMap<u32, Vec<TrueLine>>) -> Result<()> {
        trees.keys().try_for_each(|phase| self.check_phase(*phase))?;
        check_lines(&trees)?;
        lock(&self.known).trees = trees;
        Ok(())
    }

    fn check_phase(&self, phase: u32) -> Result<()> {
        let phases = self.phases();
        if phase < phases {
            return Ok(());
        }
        Err(Error::config("phase", phase, format!("is out of range: phases go from 0 to {}", phases.saturating_sub(1))))
    }

    /// Scores the frames that were added for validation, and the reconstruction against the true vessels where these are known,
    /// at their stated places, whatever calibration did to the views. `threshold_per_mm` replaces the rule for the threshold
    /// from which the dynamic field counts as vessel.
    ///
    /// # Errors
    /// [`Error::Data`] without such frames; as [`Session::render`] and [`Session::trees`].
    pub fn evaluate(&self, threshold_per_mm: Option<f64>) -> Result<Evaluation> {
        let dataset = lock(&self.shared.inbox).dataset(|_, _| true)?;
        let frames: Vec<_> = dataset.validation().iter().collect();
        let threshold = threshold_per_mm.map(|t| t * MM_PER_UNIT);
        let volumes = lock(&self.known).volumes.clone();
        let mut evaluation = self.shared.with_viewer(|live, step| {
            let renderer = live.renderer(step)?;
            let mut evaluation = evaluate(renderer, &dataset, &frames, step, threshold, |_| Ok(()))?;
            let threshold_per_mm = evaluation.threshold.dynamic_per_mm;
            evaluation.volume = score_known(renderer, live.scene(), &volumes, threshold_per_mm, pixel_mm(&dataset))?;
            evaluation.warnings.extend(moving_field_warning(renderer, &dataset)?);
            Ok(evaluation)
        })?;
        let lines = lock(&self.known).trees.clone();
        if !lines.is_empty() {
            // What `tree` finds by itself: its threshold is not that of the images.
            let mut beat = self.trees(threshold_per_mm, None)?;
            beat.phases.retain(|tree| lines.contains_key(&tree.phase));
            let at = |moment: f64| between(&lines, BeatTime::of(moment, dataset.n_phases), dataset.n_phases);
            evaluation.tree = Some(trees::score(&beat, &dataset, None, None, at)?);
        }
        evaluation.warnings.iter().for_each(|warning| tracing::warn!("{warning}"));
        Ok(evaluation)
    }
}

/// The lines at a time: those of the nearest phase, on the straight way to the next where that is known; none where neither is.
fn between(known: &BTreeMap<u32, Vec<TrueLine>>, time: BeatTime, n_phases: u32) -> Vec<TrueLine> {
    let Some(mut lines) = known.get(&time.phase).cloned() else { return Vec::new() };
    let [_, (beyond, share)] = time.shown(n_phases);
    for (line, next) in lines.iter_mut().zip(known.get(&(beyond as u32)).into_iter().flatten()) {
        line.points_mm.iter_mut().zip(&next.points_mm).for_each(|(a, b)| *a = a.lerp(*b, share));
        line.radius_mm.iter_mut().zip(&next.radius_mm).for_each(|(a, b)| *a += share * (b - *a));
    }
    lines
}

/// Refuses what is no tree over a beat.
fn check_lines(trees: &BTreeMap<u32, Vec<TrueLine>>) -> Result<()> {
    let bad = |phase: u32, problem: &str| Err(Error::config("true tree", format!("phase {phase}"), problem));
    let lengths = |lines: &[TrueLine]| lines.iter().map(|line| line.points_mm.len()).collect::<Vec<_>>();
    let Some((first, rest)) = trees.first_key_value() else { return Ok(()) };
    if *first != 0 {
        return bad(0, "has no line, but the other phases are compared with phase 0");
    }
    for (phase, lines) in trees {
        if lengths(lines) != lengths(rest) {
            return bad(*phase, "has another number of lines, or of points on a line, than phase 0");
        }
        for line in lines {
            let numbers = line.points_mm.iter().flat_map(|p| p.to_array()).chain(line.radius_mm.iter().copied());
            if line.points_mm.len() < 2 || line.radius_mm.len() != line.points_mm.len() {
                return bad(*phase, "has a line of fewer than two points, or not exactly one radius per point");
            }
            if !numbers.into_iter().all(f64::is_finite) || line.radius_mm.iter().any(|r| *r < 0.0) {
                return bad(*phase, "has a point or a radius that is not finite, or a negative radius");
            }
        }
    }
    Ok(())
}
