//! Agreement of the stenoses of a tree with the true ones.

use crate::scan::truth::TrueLesion;
use crate::score::dice::mean;
use crate::trees::lesions::{Lesion, lesions};
use crate::trees::tree::{Measurement, PhaseTree};
use glam::DVec3;
use serde::Serialize;

/// Maximum distance between the narrowest place of a stenosis and the true one, mm.
pub const FOUND_WITHIN_MM: f64 = 5.0;
/// Difference of the diameter stenosis up to which one counts as right, percentage points.
pub const RIGHT_WITHIN_POINTS: f64 = 10.0;
/// Diameter stenosis of false lesions that would have consequences, percent.
pub const SEVERE_PERCENT: f64 = 50.0;

/// A true stenosis with its place.
#[derive(Debug, Clone)]
pub struct TruePlace {
    /// The stenosis.
    pub lesion: TrueLesion,
    /// Narrowest place at the phase of the tree, LPS mm.
    pub place_mm: DVec3,
}

/// Scores of the stenoses of a tree at one phase.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LesionScores {
    /// Phase at which the tree is compared: the reference phase where points are followed.
    pub phase: u32,
    /// Number of true stenoses.
    pub true_lesions: usize,
    /// Number of true stenoses with one of ours within [`FOUND_WITHIN_MM`].
    pub found: usize,
    /// Number of these whose diameter stenosis differs by [`RIGHT_WITHIN_POINTS`] at most.
    pub within_10_points: usize,
    /// Mean of our least radius minus the true one, mm, over the stenoses that are found.
    pub min_radius_error_mm: Option<f64>,
    /// Mean of the absolute value of this difference, mm.
    pub min_radius_absolute_error_mm: Option<f64>,
    /// Mean absolute difference of the diameter stenosis, percentage points.
    pub percent_absolute_error: Option<f64>,
    /// Number of our stenoses that are not true.
    pub false_lesions: usize,
    /// Number of these of [`SEVERE_PERCENT`] or more.
    pub severe_false_lesions: usize,
}

/// Scores the stenoses that are found in a tree. Each true stenosis is compared with the nearest
/// one of ours that no other true one is nearer to.
pub fn score(tree: &PhaseTree, measurement: Measurement, truth: &[TruePlace]) -> LesionScores {
    let ours = lesions(tree, measurement);
    let place = |lesion: &Lesion| tree.branches[lesion.branch].points_mm[lesion.point];
    let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
    for (t, true_place) in truth.iter().enumerate() {
        let away = ours.iter().enumerate().map(|(o, lesion)| (place(lesion).distance(true_place.place_mm), t, o));
        pairs.extend(away.filter(|(mm, ..)| *mm <= FOUND_WITHIN_MM));
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (mut of_true, mut is_true) = (vec![None; truth.len()], vec![false; ours.len()]);
    for (_, t, o) in pairs {
        if of_true[t].is_none() && !is_true[o] {
            (of_true[t], is_true[o]) = (Some(o), true);
        }
    }
    let found = || of_true.iter().zip(truth).filter_map(|(o, place)| Some((&ours[(*o)?], &place.lesion)));
    let radius_mm = |(ours, truth): (&Lesion, &TrueLesion)| 0.5 * (ours.min_diameter_mm - truth.min_diameter_mm);
    let points = |(ours, truth): (&Lesion, &TrueLesion)| (ours.percent() - truth.percent).abs();
    let false_ones = || ours.iter().zip(&is_true).filter(|(_, is_true)| !**is_true).map(|(lesion, _)| lesion);
    LesionScores {
        phase: tree.phase,
        true_lesions: truth.len(),
        found: found().count(),
        within_10_points: found().filter(|pair| points(*pair) <= RIGHT_WITHIN_POINTS).count(),
        min_radius_error_mm: mean(found().map(radius_mm)),
        min_radius_absolute_error_mm: mean(found().map(|pair| radius_mm(pair).abs())),
        percent_absolute_error: mean(found().map(points)),
        false_lesions: false_ones().count(),
        severe_false_lesions: false_ones().filter(|lesion| lesion.percent() >= SEVERE_PERCENT).count(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trees::tree::{Branch, RadiiFrom};

    const MEASUREMENT: Measurement = Measurement { resolution_mm: 1.0, radii_from: RadiiFrom::Field };

    /// A vessel of 3 mm along superior, narrowed at places, mm, to shares of its diameter.
    fn narrowed(at: &[(f64, f64)]) -> PhaseTree {
        let factor =
            |z: f64| at.iter().map(move |(place, left)| 1.0 - (1.0 - left) * (-((z - place) / 4.0).powi(2)).exp());
        let branch = Branch {
            parent: None,
            points_mm: (0..141).map(|i| DVec3::Z * f64::from(i)).collect(),
            radius_mm: (0..141).map(|i| 1.5 * factor(f64::from(i)).product::<f64>()).collect(),
            agreement: Vec::new(),
            doubt: Vec::new(),
            gap_mm: 0.0,
        };
        PhaseTree { phase: 2, branches: vec![branch] }
    }

    fn true_place(z: f64, percent: f64) -> TruePlace {
        let lesion = TrueLesion {
            branch: "LAD".into(),
            position_mm: z,
            from_ostium_mm: z,
            length_mm: 8.0,
            reference_diameter_mm: 3.0,
            min_diameter_mm: 3.0 * (1.0 - 0.01 * percent),
            percent,
        };
        TruePlace { lesion, place_mm: DVec3::Z * z + DVec3::X }
    }

    #[test]
    fn found_missed_and_false_stenoses_are_told_apart() {
        // One is right, one far too mild, one is missed, and a severe one is false.
        let tree = narrowed(&[(30.0, 0.4), (70.0, 0.6), (110.0, 0.3)]);
        let truth = [true_place(31.0, 60.0), true_place(70.0, 70.0), true_place(90.0, 50.0)];
        let scores = score(&tree, MEASUREMENT, &truth);
        assert_eq!(
            (scores.phase, scores.true_lesions, scores.found, scores.within_10_points),
            (2, 3, 2, 1),
            "{scores:?}"
        );
        assert_eq!((scores.false_lesions, scores.severe_false_lesions), (1, 1), "{scores:?}");
        // Radii of .6 instead of .6 and of .9 instead of .45 mm.
        assert!((scores.min_radius_error_mm.unwrap() - 0.225).abs() < 0.03, "{scores:?}");
        assert!((scores.percent_absolute_error.unwrap() - 15.0).abs() < 3.0, "{scores:?}");
    }

    #[test]
    fn one_stenosis_is_not_found_twice_and_a_healthy_tree_has_none() {
        let scores = score(&narrowed(&[(50.0, 0.4)]), MEASUREMENT, &[true_place(48.0, 60.0), true_place(51.0, 60.0)]);
        assert_eq!((scores.found, scores.false_lesions), (1, 0));
        let scores = score(&narrowed(&[]), MEASUREMENT, &[]);
        assert_eq!((scores.true_lesions, scores.found, scores.false_lesions), (0, 0, 0));
        assert_eq!((scores.min_radius_error_mm, scores.percent_absolute_error), (None, None));
    }
}
