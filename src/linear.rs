//! Dense symmetric positive definite systems of some hundred unknowns.

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
}
