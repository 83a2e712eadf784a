//! How far the device is from the twins, stage by stage.

use crate::error::{Error, Result};
use serde::Serialize;

/// Returns the losses that iterations reported; none for a device that reports none, whose stages' results are compared
/// nevertheless.
pub(crate) fn told<T>(losses: Result<Vec<T>>) -> Result<Vec<T>> {
    match losses {
        Err(Error::NoDevice(_)) => Ok(Vec::new()),
        told => told,
    }
}

/// Largest error relative to the largest reference value, and where. NaN counts as infinite, and so do lists of different
/// lengths.
pub fn relative_error(got: &[f32], want: &[f64]) -> (f64, usize) {
    if got.len() != want.len() {
        return (f64::INFINITY, got.len().min(want.len()));
    }
    let scale = want.iter().fold(0f64, |m, v| m.max(v.abs())).max(1e-300);
    let mut worst = (0.0, 0);
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        let error = finite_or_infinite((f64::from(*g) - w).abs() / scale);
        if error > worst.0 {
            worst = (error, i);
        }
    }
    worst
}

/// Size of the difference relative to that of the reference, both as root mean squares. NaN counts as infinite.
pub fn relative_distance(got: &[f32], want: &[f64]) -> f64 {
    let square = |v: f64| v * v;
    let norm: f64 = want.iter().map(|w| square(*w)).sum();
    let off: f64 = got.iter().zip(want).map(|(g, w)| square(f64::from(*g) - w)).sum();
    if got.len() == want.len() { finite_or_infinite((off / norm).sqrt()) } else { f64::INFINITY }
}

fn finite_or_infinite(error: f64) -> f64 {
    if error.is_finite() { error } else { f64::INFINITY }
}

/// Tolerated deviation of numbers.
#[derive(Debug, Clone, Copy)]
pub enum Tolerance {
    /// Deviation of each number, as a share of the largest expected number.
    OfLargest(f64),
    /// Deviation of all numbers together, as a share of the norm of the expected numbers.
    OfNorm(f64),
}

impl Tolerance {
    /// Returns the tolerance, or `min` of the same kind if that is larger.
    pub fn at_least(self, min: f64) -> Tolerance {
        match self {
            Tolerance::OfLargest(max) => Tolerance::OfLargest(max.max(min)),
            Tolerance::OfNorm(max) => Tolerance::OfNorm(max.max(min)),
        }
    }

    /// Returns the tolerance multiplied by a factor.
    pub fn times(self, factor: f64) -> Tolerance {
        match self {
            Tolerance::OfLargest(max) => Tolerance::OfLargest(factor * max),
            Tolerance::OfNorm(max) => Tolerance::OfNorm(factor * max),
        }
    }
}

/// Comparisons of a stage, or of stages whose results only show together, over all cases.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// The stages whose result was compared; words with blanks name what all stages do together.
    pub stages: Vec<&'static str>,
    /// Path through the kernels: `f32`, `matrices`, or the form of Gaussians.
    pub path: String,
    /// Problems it was compared on.
    pub cases: u32,
    /// The deviation that came closest to its tolerance, or is furthest beyond; in JSON, null where it is infinite, as for
    /// values that are no numbers.
    pub deviation: f64,
    /// Tolerated deviation.
    pub tolerance: f64,
    /// Case and quantity of that deviation.
    pub seen_in: String,
    #[serde(skip)]
    last_case: String,
}

impl Row {
    /// Tells whether the stage computes what its twin does.
    pub fn is_ok(&self) -> bool {
        self.deviation <= self.tolerance
    }

    /// The stages, as text.
    pub fn name(&self) -> String {
        self.stages.join(", ")
    }
}

/// Comparisons, a row for each stage and path, in the order in which stages run: the first row that fails names the fault.
#[derive(Debug, Clone, Default)]
pub struct Findings {
    rows: Vec<Row>,
    path: String,
    case: String,
}

impl Findings {
    /// Begins a case on a path; the comparisons that follow belong to it.
    pub fn begin(&mut self, path: &str, case: &str) {
        (self.path, self.case) = (path.to_owned(), case.to_owned());
    }

    /// Every row so far.
    pub fn rows(&self) -> &[Row] {
        &self.rows
    }

    /// Records the deviation of numbers. A list of zeros is no comparison, and fails.
    pub fn numbers(
        &mut self,
        stages: &[&'static str],
        quantity: &str,
        got: &[f32],
        want: &[f64],
        tolerance: Tolerance,
    ) {
        if want.iter().all(|w| *w == 0.0) {
            return self.add(stages, &format!("{quantity}: all reference values are zero"), f64::INFINITY, 1.0);
        }
        match tolerance {
            Tolerance::OfNorm(max) => self.add(stages, quantity, relative_distance(got, want), max),
            Tolerance::OfLargest(max) => {
                let (error, at) = relative_error(got, want);
                let place = match (got.get(at), want.get(at)) {
                    (Some(got), Some(want)) => format!("{quantity}[{at}], {got:e} instead of {want:e}"),
                    _ => format!("{quantity}: {} numbers instead of {}", got.len(), want.len()),
                };
                self.add(stages, &place, error, max);
            }
        }
    }

    /// Records a failure of `stages` where a case does not hold what it is made for, for example where nothing is seen.
    pub fn require(&mut self, stages: &[&'static str], what: &str, holds: bool) {
        if !holds {
            self.add(stages, what, f64::INFINITY, 1.0);
        }
    }

    /// Records a deviation of `quantity`, a result of `stages`.
    pub fn add(&mut self, stages: &[&'static str], quantity: &str, deviation: f64, tolerance: f64) {
        let place = self.rows.iter().position(|row| row.stages == stages && row.path == self.path);
        let at = place.unwrap_or_else(|| {
            self.rows.push(Row {
                stages: stages.to_vec(),
                path: self.path.clone(),
                cases: 0,
                deviation: 0.0,
                tolerance,
                seen_in: String::new(),
                last_case: String::new(),
            });
            self.rows.len() - 1
        });
        let row = &mut self.rows[at];
        let first = row.cases == 0;
        if first || row.last_case != self.case {
            row.cases += 1;
            row.last_case.clone_from(&self.case);
        }
        let deviation = finite_or_infinite(deviation);
        if first || deviation / tolerance > row.deviation / row.tolerance {
            (row.deviation, row.tolerance) = (deviation, tolerance);
            row.seen_in = format!("{}: {quantity}", self.case);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STAGES: &[&str] = &["stage"];

    fn one(got: &[f32], want: &[f64]) -> Row {
        let mut findings = Findings::default();
        findings.begin("f32", "case");
        findings.numbers(STAGES, "numbers", got, want, Tolerance::OfLargest(1e-3));
        findings.rows()[0].clone()
    }

    #[test]
    fn what_is_wrong_fails() {
        assert!(one(&[1.0, 2.0], &[1.0, 2.001]).is_ok());
        for (got, want) in [
            (&[1.0f32, 2.0][..], &[1.0, 2.01][..]),
            (&[f32::NAN, 2.0], &[1.0, 2.0]),
            (&[f32::INFINITY], &[f64::INFINITY]),
            (&[1.0], &[1.0, 1.0]),
            (&[0.0], &[0.0]),
        ] {
            let row = one(got, want);
            assert!(!row.is_ok(), "{row:?}");
        }
        assert!(relative_distance(&[f32::NAN], &[1.0]).is_infinite() && relative_distance(&[1.0], &[]).is_infinite());
    }

    #[test]
    fn rows_keep_the_worst_of_their_cases() {
        let mut findings = Findings::default();
        for (case, deviation, tolerance) in [("a", 1e-4, 1e-3), ("a", 1e-5, 1e-6), ("b", 0.1, 1.0)] {
            findings.begin("f32", case);
            findings.add(STAGES, "x", deviation, tolerance);
        }
        findings.begin("matrices", "a");
        findings.add(STAGES, "x", f64::NAN, 1.0);
        let [row, other] = findings.rows() else { panic!("{:?}", findings.rows()) };
        assert_eq!((row.cases, row.deviation, row.tolerance, row.seen_in.as_str()), (2, 1e-5, 1e-6, "a: x"));
        assert!(!row.is_ok() && !other.is_ok());
    }
}
