//! Collimator blade in an image.

use crate::degradations::{Chance, Draw};

/// Side of the image that a blade enters from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Side {
    Left,
    Right,
    Top,
    Bottom,
}

/// A blade that hides the outer columns or rows of a view's images, with the same value at all phases.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Blade {
    side: Side,
    /// Number of columns or rows that it covers.
    lines: usize,
    /// Line integral of its attenuation.
    integral: f32,
    /// Share of the moving vessels' mass that it hides.
    pub(super) cut_share: f64,
}

impl Blade {
    /// Makes a blade on a random side that hides about a share of `moving`, the moving mass in each pixel of a square image.
    pub(super) fn hiding(share: f64, moving: &[f64], size: usize, integral: f32, chance: Chance) -> Blade {
        let sides = [Side::Left, Side::Right, Side::Top, Side::Bottom];
        let side = sides[(chance.uniform(Draw::Blade) * sides.len() as f64) as usize];
        let mut lines_mass = vec![0.0; size];
        for (pixel, mass) in moving.iter().enumerate() {
            lines_mass[line(side, pixel, size)] += mass;
        }
        let total = lines_mass.iter().sum::<f64>().max(f64::MIN_POSITIVE);
        let (mut hidden, mut best) = (0.0, (0, 0.0));
        for (index, mass) in lines_mass.iter().enumerate() {
            hidden += mass / total;
            if (hidden - share).abs() < (best.1 - share).abs() {
                best = (index + 1, hidden);
            }
        }
        Blade { side, lines: best.0, integral, cut_share: best.1 }
    }

    /// Draws the blade over an image and removes the hidden pixels from its mask.
    pub(super) fn close(&self, image: &mut [f32], mask: Option<&mut Vec<bool>>, size: usize) {
        let covered = |pixel: usize| line(self.side, pixel, size) < self.lines;
        image.iter_mut().enumerate().filter(|(pixel, _)| covered(*pixel)).for_each(|(_, value)| *value = self.integral);
        for (pixel, vessel) in mask.into_iter().flatten().enumerate() {
            *vessel &= !covered(pixel);
        }
    }
}

/// Number of columns or rows between a pixel and a side.
fn line(side: Side, pixel: usize, size: usize) -> usize {
    match side {
        Side::Left => pixel % size,
        Side::Right => size - 1 - pixel % size,
        Side::Top => pixel / size,
        Side::Bottom => size - 1 - pixel / size,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blade_hides_the_share_asked_for_on_every_side() {
        let size = 50;
        let moving: Vec<f64> = (0..size * size).map(|i| 1.0 + ((i * 7919) % 13) as f64).collect();
        let mut sides = Vec::new();
        for view in 0..20 {
            let blade = Blade::hiding(0.1, &moving, size, 9.0, Chance { seed: 1, view });
            let (mut image, mut mask) = (vec![1.0; size * size], vec![true; size * size]);
            blade.close(&mut image, Some(&mut mask), size);
            let hidden: f64 = image.iter().zip(&moving).filter(|(v, _)| **v == 9.0).map(|(_, m)| m).sum();
            let hidden = hidden / moving.iter().sum::<f64>();
            assert!((hidden - blade.cut_share).abs() < 1e-9 && (hidden - 0.1).abs() < 0.011, "{hidden}");
            assert!(image.iter().zip(&mask).all(|(v, m)| *m == (*v == 1.0)), "nothing is seen behind a blade");
            if !sides.contains(&blade.side) {
                sides.push(blade.side);
            }
        }
        assert_eq!(sides.len(), 4, "{sides:?}");
        let nothing = Blade::hiding(0.1, &vec![0.0; size * size], size, 9.0, Chance { seed: 1, view: 0 });
        assert_eq!((nothing.lines, nothing.cut_share), (0, 0.0), "where nothing moves nothing is hidden");
    }
}
