//! Shadows of vessel points: the line integrals that a unit of area at each point of a tree adds to an image.

use glam::DVec2;

/// Standard deviations that a shadow reaches to each side of its centre.
const REACH: f64 = 3.5;

/// Shadow of a point of a vessel in an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct PointShadow {
    /// Index of the point among all points of the tree.
    pub point: usize,
    /// Centre in the image, pixels.
    pub centre: DVec2,
    /// Standard deviation along columns and rows, pixels.
    pub deviation_px: f64,
    /// Sum of the line integrals over the pixels, for an area of 1 mm^2.
    pub sum: f64,
}

/// Pixels of a shadow: a product of a factor for each row and one for each column.
#[derive(Debug)]
struct Spot {
    point: usize,
    left: usize,
    top: usize,
    columns: usize,
    rows: usize,
    /// Place of the factors of the rows, which those of the columns follow.
    factors: usize,
}

/// Shadows of the points of a tree in an image: a linear map from areas, mm^2, to line integrals, and its transpose.
#[derive(Debug)]
pub(super) struct Shadows {
    width: usize,
    spots: Vec<Spot>,
    factors: Vec<f32>,
}

impl Shadows {
    /// Returns the shadows of points in an image of a size (columns, rows). Parts beyond its borders are left out.
    pub fn new(points: impl Iterator<Item = PointShadow>, size: [usize; 2]) -> Shadows {
        let mut shadows = Shadows { width: size[0], spots: Vec::new(), factors: Vec::new() };
        for shadow in points {
            let reach = REACH * shadow.deviation_px;
            let range = |centre: f64, n: usize| {
                let first = (centre - reach).ceil().clamp(0.0, n as f64) as usize;
                first..((centre + reach).floor() + 1.0).clamp(first as f64, n as f64) as usize
            };
            let (columns, rows) = (range(shadow.centre.x, size[0]), range(shadow.centre.y, size[1]));
            if columns.is_empty() || rows.is_empty() {
                continue;
            }
            shadows.spots.push(Spot {
                point: shadow.point,
                left: columns.start,
                top: rows.start,
                columns: columns.len(),
                rows: rows.len(),
                factors: shadows.factors.len(),
            });
            let height = shadow.sum / (shadow.deviation_px.powi(2) * std::f64::consts::TAU);
            let factor = |at: usize, centre: f64| (-0.5 * ((at as f64 - centre) / shadow.deviation_px).powi(2)).exp();
            shadows.factors.extend(rows.map(|row| (height * factor(row, shadow.centre.y)) as f32));
            shadows.factors.extend(columns.map(|column| factor(column, shadow.centre.x) as f32));
        }
        shadows
    }

    fn factors_of(&self, spot: &Spot) -> (&[f32], &[f32]) {
        self.factors[spot.factors..][..spot.rows + spot.columns].split_at(spot.rows)
    }

    /// Returns the line integrals of vessels with areas, mm^2, in an image of a number of pixels.
    pub fn image(&self, areas: &[f64], n_pixels: usize) -> Vec<f64> {
        let mut image = vec![0.0; n_pixels];
        for spot in &self.spots {
            let (rows, columns) = self.factors_of(spot);
            for (j, row) in rows.iter().enumerate() {
                let factor = areas[spot.point] * f64::from(*row);
                let pixels = &mut image[(spot.top + j) * self.width + spot.left..][..spot.columns];
                pixels.iter_mut().zip(columns).for_each(|(pixel, column)| *pixel += factor * f64::from(*column));
            }
        }
        image
    }

    /// Adds to each point the sum of the pixels of an image, weighted by the point's shadow: the transpose of [`Shadows::image`].
    pub fn add_sums(&self, image: &[f64], sums: &mut [f64]) {
        for spot in &self.spots {
            let (rows, columns) = self.factors_of(spot);
            for (j, row) in rows.iter().enumerate() {
                let pixels = &image[(spot.top + j) * self.width + spot.left..][..spot.columns];
                let sum: f64 = pixels.iter().zip(columns).map(|(pixel, column)| pixel * f64::from(*column)).sum();
                sums[spot.point] += f64::from(*row) * sum;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shadow_has_its_sum_and_the_transpose_is_one() {
        let size = [40, 30];
        let shadow = |point: usize, x: f64, y: f64, sum: f64| PointShadow {
            point,
            centre: DVec2::new(x, y),
            deviation_px: 1.1 + 0.2 * point as f64,
            sum,
        };
        // The third lies half beyond a border, the last one outside.
        let points = [
            shadow(0, 12.3, 11.8, 2.0),
            shadow(1, 14.0, 12.5, 0.5),
            shadow(2, -0.5, 20.0, 1.0),
            shadow(3, 90.0, 5.0, 9.0),
        ];
        let shadows = Shadows::new(points.into_iter(), size);
        let one = |point: usize| {
            let mut areas = [0.0; 4];
            areas[point] = 3.0;
            shadows.image(&areas, 40 * 30)
        };
        let sum = |point: usize| one(point).iter().sum::<f64>();
        assert!((sum(0) - 6.0).abs() < 0.01 && (sum(1) - 1.5).abs() < 0.01, "{} {}", sum(0), sum(1));
        assert!((sum(2) - 1.5).abs() < 0.05 && sum(3) == 0.0, "{} {}", sum(2), sum(3));
        let brightest = one(0).iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1)).unwrap().0;
        assert_eq!([brightest % 40, brightest / 40], [12, 12]);
        // (K a) . p = a . (K^T p)
        let (areas, pixels) = ([0.7, 1.9, 0.4, 2.2], |p: usize| ((p * 37) % 11) as f64 - 4.0);
        let image: Vec<f64> = (0..40 * 30).map(pixels).collect();
        let mut sums = [0.0; 4];
        shadows.add_sums(&image, &mut sums);
        let left: f64 = shadows.image(&areas, 40 * 30).iter().zip(&image).map(|(a, b)| a * b).sum();
        let right: f64 = areas.iter().zip(sums).map(|(a, b)| a * b).sum();
        assert!((left - right).abs() < 1e-9 * left.abs().max(1.0), "{left} {right}");
    }
}
