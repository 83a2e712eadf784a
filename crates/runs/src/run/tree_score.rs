//! Scores of a tree, where a dataset has its vessels as one.

use crate::calibrate::gauge::RigidMotion;
use crate::error::Result;
use crate::scan::dataset::Dataset;
use crate::scan::truth::{TRUTH, TrueLesion, Truth, VOLUMES};
use crate::score::calibrated::{carried_by, in_calibrated_frame};
use crate::score::lesions::{self, LesionScores, TruePlace};
use crate::score::trees::{self, TreeScores, TrueLine};
use crate::trees::tree::{BeatTree, PhaseTree};
use glam::DVec3;
use nertca_vk_phantom::tree::{Branch, Tree};
use nertca_vk_phantom::tree_file::{TREE, TreeFile};

/// Scores a tree of all phases against the true tree of a phantom; `None` where there is none. The dataset has the geometry
/// that the reconstruction used. Scores are computed in the frame of the reconstruction; the means without this motion are
/// reported as well.
///
/// # Errors
/// [`crate::error::Error::Io`] and [`crate::error::Error::Data`] for a truth that cannot be read.
pub fn score_tree(beat: &BeatTree, dataset: &Dataset) -> Result<Option<TreeScores>> {
    let file = dataset.path.join(VOLUMES).join(TREE);
    if !file.is_file() {
        return Ok(None);
    }
    let truth = TreeFile::read(&file)?;
    let lines = |moment: f64| {
        let tree = truth.at(moment / f64::from(dataset.n_phases));
        let line = |branch: Branch| TrueLine { points_mm: branch.points, radius_mm: branch.radius_mm };
        tree.branches.into_iter().map(line).collect()
    };
    let (carried, motion) = (in_calibrated_frame(dataset)?, carried_by(dataset)?);
    let taken = dataset.path.join(TRUTH).is_file().then(|| Truth::load(&dataset.path)).transpose()?;
    let score = |dataset, motion| trees::score(beat, dataset, taken.as_ref(), motion, lines);
    let mut scores = score(carried.as_ref().unwrap_or(dataset), motion.as_ref())?;
    if carried.is_some() || motion.is_some() {
        scores.mean_as_stated = Some(score(dataset, None)?.mean);
    }
    scores.lesions = taken.and_then(|taken| lesion_scores(beat, &truth, &taken, motion.as_ref()));
    Ok(Some(scores))
}

/// Scores the stenoses at the reference phase, or at the first phase of the tree where points are not followed. `motion` carries the truth to
/// the frame of the reconstruction.
fn lesion_scores(
    beat: &BeatTree,
    truth: &TreeFile,
    taken: &Truth,
    motion: Option<&RigidMotion>,
) -> Option<LesionScores> {
    let is_reference = |tree: &&PhaseTree| Some(tree.phase) == beat.reference_phase;
    let tree = beat.phases.iter().find(is_reference).or(beat.phases.first())?;
    let (rest, now) = (truth.at(0.0), truth.at(f64::from(tree.phase) / f64::from(taken.phases)));
    let place = |lesion: &TrueLesion| {
        let place_mm = place_at(lesion, &rest, &now)?;
        let carry = motion.map(|motion| motion.patient_mm(tree.phase as usize));
        let place_mm = carry.map_or(place_mm, |carry| carry.transform_point3(place_mm));
        Some(TruePlace { lesion: lesion.clone(), place_mm })
    };
    let places: Option<Vec<TruePlace>> = taken.lesions.iter().map(place).collect();
    Some(lesions::score(tree, beat.measurement(), &places?))
}

/// Returns the narrowest place of a true stenosis in the tree `now`, LPS mm; its position is stated along the branch at rest. `None` for a
/// branch that the tree does not have.
fn place_at(lesion: &TrueLesion, rest: &Tree, now: &Tree) -> Option<DVec3> {
    let index = rest.branches.iter().position(|branch| branch.name == lesion.branch)?;
    let mut along_mm = 0.0;
    let points = &rest.branches[index].points;
    let ways: Vec<f64> = points
        .iter()
        .enumerate()
        .map(|(i, point)| {
            along_mm += i.checked_sub(1).map_or(0.0, |before| points[before].distance(*point));
            along_mm
        })
        .collect();
    let away_mm = |i: &usize| (ways[*i] - lesion.position_mm).abs();
    let at = (0..ways.len()).min_by(|a, b| away_mm(a).total_cmp(&away_mm(b)))?;
    now.branches.get(index)?.points.get(at).copied()
}
