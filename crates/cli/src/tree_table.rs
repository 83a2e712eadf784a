//! Scores of a tree as a table.

use super::score_table::{Column, ScoreTable, mm, percent};
use nertca_vk::score::trees::{TreeAgreement, TreeScores};

const COLUMNS: [Column<TreeAgreement>; 10] = [
    Column { heading: ["centreline", "found"], text: |s| percent(Some(s.true_centreline_found)) },
    Column { heading: ["centreline", "true"], text: |s| percent(Some(s.our_centreline_true)) },
    Column { heading: ["distance to", "true, mm"], text: |s| mm(Some(s.ours_to_true_mm)) },
    Column { heading: ["radius error", "mean, mm"], text: |s| mm(s.radius_error_mm) },
    Column { heading: ["radius error", "RMS, mm"], text: |s| mm(s.radius_rmse_mm) },
    Column { heading: ["", "components"], text: |s| format!("{:.1}", s.components) },
    Column { heading: ["in training", "images, mm"], text: |s| mm(s.reprojection_training_mm) },
    Column { heading: ["in unseen", "images, mm"], text: |s| mm(s.reprojection_unseen_mm) },
    Column { heading: ["within", "doubt"], text: |s| percent(s.within_doubt) },
    Column { heading: ["motion", "error, mm"], text: |s| mm(s.motion_error_mm) },
];

/// Returns the table of all phases and their mean.
pub fn table(tree: &TreeScores) -> ScoreTable {
    let legend = format!(
        "The extracted vessel tree is compared with the true one. Centrelines agree where their distance is at most {} \
         mm, and radii are compared there. In images, the score is the mean distance at the isocentre. The motion \
         error compares the displacements of points since the reference phase (mostly 0). Within doubt \
         is the share whose true place is inside the 68 % interval of the point.",
        tree.within_mm
    );
    let phases = tree.phases.iter().map(|p| (p.phase, &p.scores));
    ScoreTable::new("Scores of the tree", legend, &COLUMNS, phases, &tree.mean, tree.mean_as_stated.as_ref())
}
