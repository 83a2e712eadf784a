//! Carving the motion hull: a cell is kept where every view that sees it shows motion.

use crate::fields::motion::ViewMotion;
use crate::geometry::ViewRays;
use crate::model::hull::Hull;
use crate::scan::dataset::Dataset;
use glam::{DMat3, DVec3};
use rayon::prelude::*;

/// Cells of a cube of half side `half` (world units) that every view seeing them shows moving; at least
/// two views (or the only one) must see them. With `per_phase`, cells are kept for the phases at which
/// every view that has the phase shows something there.
pub fn carve(dataset: &Dataset, motion: &[ViewMotion], half: f64, resolution: usize, per_phase: bool) -> Hull {
    let n = resolution;
    let cells = n * n * n;
    let cell = 2.0 * half / n as f64;
    let min = DVec3::splat(-half);
    let projectors: Vec<_> =
        motion.iter().map(|m| Projector::new(dataset, m.view, &dataset.views[m.view].rays)).collect();
    let needed = motion.len().min(2);
    // For each kept cell, the pixel it falls on in each view.
    let kept: Vec<(usize, Vec<Option<usize>>)> = (0..cells)
        .into_par_iter()
        .filter_map(|index| {
            let (x, y, z) = (index % n, index / n % n, index / (n * n));
            let centre = min + (DVec3::new(x as f64, y as f64, z as f64) + 0.5) * cell;
            let mut pixels = Vec::with_capacity(projectors.len());
            for (projector, m) in projectors.iter().zip(motion) {
                let pixel = projector.pixel(centre);
                if pixel.is_some_and(|p| !m.moving[p]) {
                    return None;
                }
                pixels.push(pixel);
            }
            (pixels.iter().flatten().count() >= needed).then_some((index, pixels))
        })
        .collect();
    let n_phases = if per_phase { dataset.n_phases as usize } else { 1 };
    let words = cells.div_ceil(32);
    let mut bits = vec![0u32; words * n_phases];
    for (phase, bits) in bits.chunks_mut(words).enumerate() {
        for (index, pixels) in &kept {
            let shown = |(pixel, m): (&Option<usize>, &ViewMotion)| {
                let at = &m.moving_at[phase];
                pixel.is_none_or(|p| !per_phase || at.is_empty() || at[p])
            };
            if pixels.iter().zip(motion).all(shown) {
                bits[index / 32] |= 1 << (index % 32);
            }
        }
    }
    Hull { size: [n; 3], min, cell, n_phases, bits }
}

/// Projection of world points to pixels of a view.
pub(crate) struct Projector<'a> {
    source: DVec3,
    inverse: DMat3,
    width: usize,
    height: usize,
    hidden: Option<&'a [bool]>,
}

impl<'a> Projector<'a> {
    /// Creates the projector of a view from `rays`: the view's own, or those by which a frame of the view sees the heart.
    pub(crate) fn new(dataset: &'a Dataset, view: usize, rays: &ViewRays) -> Self {
        let basis = DMat3::from_cols(rays.direction[1], rays.direction[2], rays.direction[0]);
        let (width, height, hidden) = (dataset.width, dataset.height, dataset.hidden_of(view));
        Projector { source: rays.source(), inverse: basis.inverse(), width, height, hidden }
    }

    /// Index of the pixel a point falls on; `None` when the view does not see it.
    pub(crate) fn pixel(&self, point: DVec3) -> Option<usize> {
        let h = self.inverse * (point - self.source);
        if h.z <= 0.0 {
            return None;
        }
        let inverse_depth = h.z.recip();
        let (column, row) = (nearest(h.x * inverse_depth, self.width)?, nearest(h.y * inverse_depth, self.height)?);
        let pixel = row * self.width + column;
        self.hidden.is_none_or(|hidden| !hidden[pixel]).then_some(pixel)
    }
}

/// Returns the index nearest to a position; `None` where it is not below `n`. A conversion to an integer takes a fraction of the time of a
/// function that rounds.
fn nearest(position: f64, n: usize) -> Option<usize> {
    let above = position + 0.5;
    (above > 0.0 && above < n as f64).then_some(above as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_pixel_is_that_of_rounding() {
        let positions = [-7.3, -0.51, -0.5, -0.49, 0.0, 0.49, 0.5, 3.499, 3.5, 4.51, 6.49, 6.5, 6.51, 1e30, -1e30];
        for position in positions {
            let rounded: f64 = f64::round(position);
            let expected = (0.0..7.0).contains(&rounded).then_some(rounded as usize);
            assert_eq!(nearest(position, 7), expected, "{position}");
        }
        assert_eq!([nearest(f64::NAN, 7), nearest(f64::INFINITY, 7)], [None; 2]);
    }
}
