//! Stenoses: places where a vessel of a phantom is narrowed.

use crate::error::{Error, Result};
use crate::scan::truth::TrueLesion;
use crate::tree::Tree;
use serde::{Deserialize, Serialize};
use std::f64::consts::TAU;

/// Minimum number of points of the centreline within a stenosis. Fewer do not show its shape.
const MIN_POINTS: usize = 5;
/// Largest accepted narrowing of the diameter, percent.
const LARGEST_PERCENT: f64 = 95.0;

/// A stenosis that a phantom is asked for.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Stenosis {
    /// Name of the branch, as the tree has it.
    pub branch: String,
    /// Position of the least diameter, mm along the branch from its first point, at rest.
    pub position_mm: f64,
    /// Narrowing of the diameter, percent of the diameter without the stenosis: 0 to 95.
    pub percent: f64,
    /// Length along the branch, mm.
    pub length_mm: f64,
}

impl Stenosis {
    /// Returns the share of the radius that is left at a distance, mm, from the least diameter: a raised cosine.
    fn left(&self, away_mm: f64) -> f64 {
        if away_mm.abs() >= 0.5 * self.length_mm {
            return 1.0;
        }
        1.0 - 0.005 * self.percent * (1.0 + (TAU * away_mm / self.length_mm).cos())
    }

    /// Returns the error for a stenosis, written as the option that asks for it.
    fn refused(&self, problem: String) -> Error {
        let asked = format!("{},{},{},{}", self.branch, self.position_mm, self.percent, self.length_mm);
        Error::config("stenosis", asked, problem)
    }
}

/// Factors on the radii of a tree, for each branch and point.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Narrowing {
    factors: Vec<Vec<f64>>,
}

impl Narrowing {
    /// Finds the points that stenoses narrow in a tree at rest, and describes the lesions that result.
    ///
    /// # Errors
    /// [`Error::Config`] for a branch that the tree does not have, a place beyond its ends, an impossible size, or a stenosis on
    /// fewer than five points of the centreline.
    pub(super) fn new(rest: &Tree, stenoses: &[Stenosis]) -> Result<(Narrowing, Vec<TrueLesion>)> {
        if stenoses.is_empty() {
            return Ok((Narrowing::default(), Vec::new()));
        }
        let ways_mm = rest.ways_mm();
        let mut factors: Vec<Vec<f64>> = rest.branches.iter().map(|branch| vec![1.0; branch.points.len()]).collect();
        let mut lesions = Vec::new();
        for stenosis in stenoses {
            let index = branch_of(rest, stenosis)?;
            let (branch, ways_mm) = (&rest.branches[index], &ways_mm[index]);
            let along_mm: Vec<f64> = ways_mm.iter().map(|way| way - ways_mm[0]).collect();
            check(stenosis, &along_mm)?;
            for (factor, along) in factors[index].iter_mut().zip(&along_mm) {
                *factor = factor.min(stenosis.left(along - stenosis.position_mm));
            }
            let away_mm = |i: &usize| (along_mm[*i] - stenosis.position_mm).abs();
            let at = (0..along_mm.len()).min_by(|a, b| away_mm(a).total_cmp(&away_mm(b))).unwrap_or(0);
            let reference_diameter_mm = 2.0 * branch.radius_mm[at];
            lesions.push(TrueLesion {
                branch: stenosis.branch.clone(),
                position_mm: stenosis.position_mm,
                from_ostium_mm: ways_mm[at],
                length_mm: stenosis.length_mm,
                reference_diameter_mm,
                min_diameter_mm: reference_diameter_mm * (1.0 - 0.01 * stenosis.percent),
                percent: stenosis.percent,
            });
        }
        Ok((Narrowing { factors }, lesions))
    }

    /// Narrows a tree with the branches and points of the one that the factors were found in.
    pub(super) fn applied(&self, mut tree: Tree) -> Tree {
        for (branch, factors) in tree.branches.iter_mut().zip(&self.factors) {
            branch.radius_mm.iter_mut().zip(factors).for_each(|(radius, factor)| *radius *= factor);
        }
        tree
    }
}

/// Returns the index of the branch of a stenosis.
fn branch_of(tree: &Tree, stenosis: &Stenosis) -> Result<usize> {
    let found = tree.branches.iter().position(|branch| branch.name == stenosis.branch);
    found.ok_or_else(|| {
        let names: Vec<&str> = tree.branches.iter().map(|branch| branch.name.as_str()).collect();
        stenosis.refused(format!("names a branch that the tree does not have; its branches are: {}", names.join(", ")))
    })
}

/// Refuses a stenosis that cannot be on a branch whose points lie at these lengths from its first point.
fn check(stenosis: &Stenosis, along_mm: &[f64]) -> Result<()> {
    let Stenosis { position_mm, percent, length_mm, .. } = *stenosis;
    if !(0.0..=LARGEST_PERCENT).contains(&percent) {
        return Err(
            stenosis.refused(format!("narrows the diameter by {percent} %; 0 to {LARGEST_PERCENT} % are accepted"))
        );
    }
    if !(length_mm.is_finite() && length_mm > 0.0) {
        return Err(stenosis.refused(format!("has a length of {length_mm} mm, which is not positive")));
    }
    let end_mm = along_mm.last().copied().unwrap_or(0.0);
    if !(0.0..=end_mm).contains(&position_mm) {
        let problem = format!("lies at {position_mm} mm of a branch that is {end_mm:.1} mm long");
        return Err(stenosis.refused(problem));
    }
    let points = along_mm.iter().filter(|along| (**along - position_mm).abs() < 0.5 * length_mm).count();
    if points < MIN_POINTS {
        let problem = format!(
            "contains {points} points of the branch's centreline, and at least {MIN_POINTS} are needed to give it a shape: \
             choose a longer stenosis or a tree with more points"
        );
        return Err(stenosis.refused(problem));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tree::Branch;
    use glam::DVec3;

    /// A trunk of 40 mm along x and a branch of 20 mm that leaves its middle, both of 2 mm radius, with a point every mm.
    fn tree() -> Tree {
        let line = |name: &str, from: DVec3, to: DVec3, n: usize| Branch {
            name: name.to_owned(),
            points: (0..=n).map(|i| from.lerp(to, i as f64 / n as f64)).collect(),
            radius_mm: vec![2.0; n + 1],
            filling: vec![1.0; n + 1],
        };
        let (trunk, branch) = (DVec3::X * 40.0, DVec3::X * 20.0);
        Tree { branches: vec![line("T", DVec3::ZERO, trunk, 40), line("B", branch, branch + DVec3::Y * 20.0, 20)] }
    }

    fn stenosis(branch: &str, position_mm: f64, percent: f64, length_mm: f64) -> Stenosis {
        Stenosis { branch: branch.to_owned(), position_mm, percent, length_mm }
    }

    #[test]
    fn a_stenosis_narrows_its_branch_where_and_as_far_as_it_says() {
        let (narrowing, lesions) = Narrowing::new(&tree(), &[stenosis("B", 10.0, 60.0, 8.0)]).unwrap();
        let narrowed = narrowing.applied(tree());
        assert_eq!(narrowed.branches[0], tree().branches[0], "another branch stays");
        let radii = &narrowed.branches[1].radius_mm;
        assert!((radii[10] - 0.8).abs() < 1e-12, "60 % of 2 mm are gone: {}", radii[10]);
        assert!((radii[8] - 1.4).abs() < 1e-12, "half of the narrowing at half of the way: {}", radii[8]);
        assert_eq!((radii[5], radii[6], radii[14], radii[15]), (2.0, 2.0, 2.0, 2.0));
        let [lesion] = &lesions[..] else { panic!("{lesions:?}") };
        assert_eq!((lesion.reference_diameter_mm, lesion.from_ostium_mm), (4.0, 30.0));
        assert!((lesion.min_diameter_mm - 1.6).abs() < 1e-12);
    }

    #[test]
    fn stenoses_that_cannot_be_are_refused_with_the_reason() {
        for (asked, reason) in [
            (stenosis("C", 10.0, 50.0, 8.0), "its branches are: T, B"),
            (stenosis("B", 21.0, 50.0, 8.0), "20.0 mm long"),
            (stenosis("B", f64::NAN, 50.0, 8.0), "20.0 mm long"),
            (stenosis("B", 10.0, 99.0, 8.0), "0 to 95 %"),
            (stenosis("B", 10.0, f64::NAN, 8.0), "0 to 95 %"),
            (stenosis("B", 10.0, 50.0, -8.0), "not positive"),
            (stenosis("B", 10.0, 50.0, 3.0), "at least 5 are needed"),
        ] {
            let said = Narrowing::new(&tree(), &[asked]).unwrap_err().to_string();
            assert!(said.contains(reason), "{said}");
        }
    }
}
