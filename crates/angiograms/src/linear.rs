//! Symmetric positive definite systems: dense ones of some hundred unknowns, banded ones of any size, and those that are given by their product
//! with a vector.

/// Maximum number of iterations of the conjugate gradients, and the residual at which they end, as a share of the right side.
const MAX_ITERATIONS: usize = 200;
const RESIDUAL: f64 = 1e-6;

/// The lower triangle of a symmetric matrix, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Symmetric {
    n: usize,
    rows: Vec<f64>,
}

impl Symmetric {
    /// Returns a matrix of zeros.
    pub fn zeros(n: usize) -> Symmetric {
        Symmetric { n, rows: vec![0.0; n * (n + 1) / 2] }
    }

    fn row(&self, i: usize) -> &[f64] {
        &self.rows[i * (i + 1) / 2..][..=i]
    }

    /// Adds to an entry and its mirror.
    pub fn add(&mut self, i: usize, j: usize, value: f64) {
        let (i, j) = (i.max(j), i.min(j));
        self.rows[i * (i + 1) / 2 + j] += value;
    }

    /// Adds another matrix.
    pub fn add_all(&mut self, other: &Symmetric) {
        self.rows.iter_mut().zip(&other.rows).for_each(|(a, b)| *a += b);
    }

    /// Multiplies all entries.
    pub fn scale(&mut self, factor: f64) {
        self.rows.iter_mut().for_each(|a| *a *= factor);
    }

    /// Solves `self x = right` by Cholesky; `None` where the matrix is not positive definite.
    pub fn solve(&self, right: &[f64]) -> Option<Vec<f64>> {
        let mut factor = Symmetric::zeros(self.n);
        for i in 0..self.n {
            for j in 0..=i {
                let sum: f64 = factor.row(i)[..j].iter().zip(factor.row(j)).map(|(a, b)| a * b).sum();
                let left = self.row(i)[j] - sum;
                let entry = if i == j { left.sqrt() } else { left / factor.row(j)[j] };
                if !entry.is_finite() || (i == j && entry == 0.0) {
                    return None;
                }
                factor.add(i, j, entry);
            }
        }
        let mut x = right.to_vec();
        for i in 0..self.n {
            let sum: f64 = factor.row(i)[..i].iter().zip(&x).map(|(a, b)| a * b).sum();
            x[i] = (x[i] - sum) / factor.row(i)[i];
        }
        for i in (0..self.n).rev() {
            x[i] /= factor.row(i)[i];
            let value = x[i];
            x[..i].iter_mut().zip(factor.row(i)).for_each(|(x, a)| *x -= a * value);
        }
        Some(x)
    }
}

/// A symmetric matrix with two diagonals on each side of the main one.
#[derive(Debug, Clone, PartialEq)]
pub struct Pentadiagonal {
    /// Diagonals: the main one, the entries (i + 1, i) and the entries (i + 2, i); all as long as the main one.
    diagonals: [Vec<f64>; 3],
}

impl Pentadiagonal {
    /// Returns a matrix of zeros.
    pub fn zeros(n: usize) -> Pentadiagonal {
        Pentadiagonal { diagonals: [vec![0.0; n], vec![0.0; n], vec![0.0; n]] }
    }

    /// Adds to an entry and its mirror, which may be two places from the main diagonal at most.
    pub fn add(&mut self, i: usize, j: usize, value: f64) {
        self.diagonals[i.abs_diff(j)][i.min(j)] += value;
    }

    /// Solves `self x = right` by L D L^T in time proportional to the size; `None` where the matrix is not positive definite.
    pub fn solve(&self, right: &[f64]) -> Option<Vec<f64>> {
        let [main, first, second] = &self.diagonals;
        let n = main.len();
        let (mut d, mut one, mut two) = (vec![0.0; n], vec![0.0; n], vec![0.0; n]);
        let mut x = right.to_vec();
        for i in 0..n {
            d[i] = main[i];
            let mut below = first[i];
            if i >= 1 {
                d[i] -= one[i - 1] * one[i - 1] * d[i - 1];
                below -= two[i - 1] * one[i - 1] * d[i - 1];
                x[i] -= one[i - 1] * x[i - 1];
            }
            if i >= 2 {
                d[i] -= two[i - 2] * two[i - 2] * d[i - 2];
                x[i] -= two[i - 2] * x[i - 2];
            }
            if !(d[i].is_finite() && d[i] > 0.0) {
                return None;
            }
            (one[i], two[i]) = (below / d[i], second[i] / d[i]);
        }
        for i in (0..n).rev() {
            x[i] /= d[i];
            for (offset, factor) in [(1, one[i]), (2, two[i])] {
                if i + offset < n {
                    x[i] -= factor * x[i + offset];
                }
            }
        }
        Some(x)
    }
}

/// Solves a symmetric positive definite system that is given by its product with a vector, by conjugate gradients from `start`. It ends after
/// 200 iterations at the latest, with the solution so far.
pub fn conjugate_gradients(applied: impl Fn(&[f64]) -> Vec<f64>, right: &[f64], start: &[f64]) -> Vec<f64> {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let mut x = start.to_vec();
    let mut residual: Vec<f64> = right.iter().zip(applied(&x)).map(|(b, a)| b - a).collect();
    let mut way = residual.clone();
    let mut square = dot(&residual, &residual);
    let enough = RESIDUAL.powi(2) * dot(right, right);
    for _ in 0..MAX_ITERATIONS {
        if square <= enough {
            break;
        }
        let product = applied(&way);
        let step = square / dot(&way, &product);
        x.iter_mut().zip(&way).for_each(|(x, way)| *x += step * way);
        residual.iter_mut().zip(&product).for_each(|(r, product)| *r -= step * product);
        let next = dot(&residual, &residual);
        way.iter_mut().zip(&residual).for_each(|(way, r)| *way = r + next / square * *way);
        square = next;
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn solutions_solve() {
        let mut matrix = Symmetric::zeros(3);
        for (i, j, v) in [(0, 0, 4.0), (0, 1, 1.0), (1, 1, 3.0), (2, 0, -1.0), (2, 1, 0.5), (2, 2, 5.0)] {
            matrix.add(i, j, v);
        }
        let x = matrix.solve(&[1.0, 2.0, 3.0]).unwrap();
        let rows = [[4.0, 1.0, -1.0], [1.0, 3.0, 0.5], [-1.0, 0.5, 5.0]];
        for (row, want) in rows.iter().zip([1.0, 2.0, 3.0]) {
            let got: f64 = row.iter().zip(&x).map(|(a, b)| a * b).sum();
            assert!((got - want).abs() < 1e-12);
        }
        matrix.add(0, 0, -5.0);
        assert_eq!(matrix.solve(&[1.0; 3]), None);
    }

    #[test]
    fn a_banded_system_has_the_solution_of_the_dense_one() {
        for n in [1, 2, 3, 9] {
            let (mut banded, mut dense) = (Pentadiagonal::zeros(n), Symmetric::zeros(n));
            for i in 0..n {
                for j in i.saturating_sub(2)..=i {
                    let value = if i == j { 5.0 + i as f64 } else { 0.3 * (1 + i + 2 * j) as f64 / n as f64 - 0.8 };
                    banded.add(i, j, value);
                    dense.add(i, j, value);
                }
            }
            let right: Vec<f64> = (0..n).map(|i| (i as f64).sin() + 0.5).collect();
            let (ours, theirs) = (banded.solve(&right).unwrap(), dense.solve(&right).unwrap());
            assert!(ours.iter().zip(&theirs).all(|(a, b)| (a - b).abs() < 1e-12), "{n}: {ours:?}, {theirs:?}");
        }
        assert_eq!(Pentadiagonal::zeros(3).solve(&[1.0; 3]), None);
    }

    #[test]
    fn the_system_is_solved() {
        // Diagonally dominant, symmetric.
        let applied = |x: &[f64]| vec![4.0 * x[0] - x[1], 3.0 * x[1] - x[0] + 0.5 * x[2], 2.0 * x[2] + 0.5 * x[1]];
        let wanted = [1.0, -2.0, 0.7];
        let found = conjugate_gradients(applied, &applied(&wanted), &[0.0; 3]);
        assert!(found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-5), "{found:?}");
    }
}
