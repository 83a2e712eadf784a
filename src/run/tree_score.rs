//! Scores of a tree, where a dataset has its vessels as one.

use crate::error::Result;
use crate::phantom::tree::Branch;
use crate::phantom::tree_file::{TREE, TreeFile};
use crate::scan::dataset::Dataset;
use crate::scan::truth::{TRUTH, Truth};
use crate::score::calibrated::{carried_by, in_calibrated_frame};
use crate::score::trees::{self, TreeScores, TrueLine};
use crate::score::volume::VOLUMES;
use crate::trees::tree::BeatTree;

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
    Ok(Some(scores))
}
