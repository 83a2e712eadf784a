//! Scores of a tree as a table.

use crate::pages::score_table::{Column, ScoreTable, mm, percent};
use nertca_vk_vessels::score::lesions::{FOUND_WITHIN_MM, LesionScores, RIGHT_WITHIN_POINTS, SEVERE_PERCENT};
use nertca_vk_vessels::score::trees::{TreeAgreement, TreeScores};

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

/// Describes the scores of the stenoses in a sentence or two; `None` where there are no stenoses at all.
pub fn lesions_in_words(scores: &LesionScores) -> Option<String> {
    if scores.true_lesions + scores.false_lesions == 0 {
        return None;
    }
    let errors = match (scores.min_radius_absolute_error_mm, scores.min_radius_error_mm, scores.percent_absolute_error)
    {
        (Some(absolute), Some(mean), Some(points)) => format!(
            "; their least radius is off by {absolute:.2} mm (mean {mean:+.2} mm), and their diameter stenosis by {points:.0} points"
        ),
        _ => String::new(),
    };
    Some(format!(
        "Stenoses at phase {}: {} of {} are found within {FOUND_WITHIN_MM} mm, {} of them to within {RIGHT_WITHIN_POINTS} points{errors}. \
         {} of the tree's stenoses are false, of which {} have {SEVERE_PERCENT} % or more.",
        scores.phase,
        scores.found,
        scores.true_lesions,
        scores.within_10_points,
        scores.false_lesions,
        scores.severe_false_lesions
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stenoses_are_told_where_there_are_any() {
        let scores = LesionScores {
            phase: 0,
            true_lesions: 3,
            found: 2,
            within_10_points: 1,
            min_radius_error_mm: Some(-0.05),
            min_radius_absolute_error_mm: Some(0.08),
            percent_absolute_error: Some(7.4),
            false_lesions: 1,
            severe_false_lesions: 0,
        };
        let told = lesions_in_words(&scores).unwrap_or_default();
        assert!(
            told.starts_with("Stenoses at phase 0: 2 of 3 are found within 5 mm, 1 of them to within 10 points"),
            "{told}"
        );
        assert!(told.contains("off by 0.08 mm (mean -0.05 mm)") && told.contains("by 7 points"), "{told}");
        assert!(told.ends_with("1 of the tree's stenoses are false, of which 0 have 50 % or more."), "{told}");
        let none = LesionScores { true_lesions: 0, false_lesions: 0, ..scores };
        assert_eq!(lesions_in_words(&none), None);
    }
}
