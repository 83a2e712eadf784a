//! Exact Euclidean distances to a set of voxels (Felzenszwalb and Huttenlocher, Theory of Computing 2012).

use crate::vessels::mask::Mask;
use rayon::prelude::*;

/// Distance of each voxel of a grid from the nearest voxel of a set, centre to centre.
pub struct DistanceMap {
    size: [usize; 3],
    /// Squared distances, mm²: rows along x, ordered along z within planes across y.
    squared_mm2: Vec<f32>,
}

impl DistanceMap {
    /// Computes the distances to a set; `None` where it is empty.
    pub fn to(mask: &Mask) -> Option<DistanceMap> {
        if !mask.inside.contains(&true) {
            return None;
        }
        let [nx, ny, nz] = mask.size;
        // The first pass is along x and then along y, within the planes across z.
        let mut planes = vec![f32::INFINITY; nx * ny * nz];
        planes.par_chunks_mut(nx * ny).zip(mask.inside.par_chunks(nx * ny)).for_each(|(plane, inside)| {
            plane.iter_mut().zip(inside).filter(|(_, inside)| **inside).for_each(|(value, _)| *value = 0.0);
            let mut envelope = Envelope::default();
            plane.chunks_mut(nx).for_each(|row| envelope.lower(row, mask.spacing_mm.x));
            lower_columns(plane, nx, mask.spacing_mm.y, &mut envelope);
        });
        // The second pass is along z, in planes across y.
        let mut squared_mm2 = vec![f32::INFINITY; nx * ny * nz];
        squared_mm2.par_chunks_mut(nx * nz).enumerate().for_each(|(y, plane)| {
            for (z, row) in plane.chunks_mut(nx).enumerate() {
                row.copy_from_slice(&planes[(z * ny + y) * nx..][..nx]);
            }
            lower_columns(plane, nx, mask.spacing_mm.z, &mut Envelope::default());
        });
        Some(DistanceMap { size: mask.size, squared_mm2 })
    }

    /// Distance of a voxel, by its index in the grid with x fastest, mm.
    pub fn at_mm(&self, index: usize) -> f32 {
        let [nx, ny, nz] = self.size;
        let (x, y, z) = (index % nx, index / nx % ny, index / (nx * ny));
        self.squared_mm2[(y * nz + z) * nx + x].sqrt()
    }
}

/// Applies [`Envelope::lower`] to each column of rows of `nx` values.
fn lower_columns(plane: &mut [f32], nx: usize, step_mm: f64, envelope: &mut Envelope) {
    let mut column = vec![0f32; plane.len() / nx];
    for x in 0..nx {
        let values = || plane.iter().skip(x).step_by(nx);
        if values().all(|v| v.is_infinite()) {
            continue;
        }
        column.iter_mut().zip(values()).for_each(|(to, from)| *to = *from);
        envelope.lower(&mut column, step_mm);
        plane.iter_mut().skip(x).step_by(nx).zip(&column).for_each(|(to, from)| *to = *from);
    }
}

/// The lower envelope of parabolas, one on each sample of a line.
#[derive(Default)]
struct Envelope {
    /// Indices of the samples whose parabolas are lowest somewhere, from left to right.
    lowest: Vec<usize>,
    /// Position from which each of them is the lowest, in samples.
    from: Vec<f64>,
    /// Heights of all samples, in units of the squared step.
    heights: Vec<f64>,
}

impl Envelope {
    /// Replaces each value by the minimum, over all values of the line, of the value plus the squared distance to it.
    /// Values are mm², or infinite.
    fn lower(&mut self, line: &mut [f32], step_mm: f64) {
        let Envelope { lowest, from, heights } = self;
        lowest.clear();
        from.clear();
        heights.clear();
        heights.extend(line.iter().map(|v| f64::from(*v) / step_mm.powi(2)));
        for (q, height) in heights.iter().enumerate().filter(|(_, height)| height.is_finite()) {
            let mut start = f64::NEG_INFINITY;
            while let Some(p) = lowest.last() {
                let squares = (height + (q * q) as f64) - (heights[*p] + (p * p) as f64);
                start = squares / (2 * (q - p)) as f64;
                if from.last().is_none_or(|last| start > *last) {
                    break;
                }
                // The last parabola is nowhere the lowest.
                lowest.pop();
                from.pop();
                start = f64::NEG_INFINITY;
            }
            lowest.push(q);
            from.push(start);
        }
        if lowest.is_empty() {
            return;
        }
        let mut k = 0;
        for (x, value) in line.iter_mut().enumerate() {
            while from.get(k + 1).is_some_and(|next| *next <= x as f64) {
                k += 1;
            }
            let away = x.abs_diff(lowest[k]) as f64;
            *value = ((heights[lowest[k]] + away * away) * step_mm.powi(2)) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::pcg4d;
    use crate::vessels::mask::tests::drawn;
    use glam::DVec3;

    #[test]
    fn distances_are_those_of_the_nearest_voxel() {
        let (size, spacing_mm) = ([9, 12, 7], DVec3::new(0.5, 0.8, 1.7));
        let [nx, ny, nz] = size;
        let position =
            |i: usize| DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / (nx * ny)) as f64) * spacing_mm;
        for seed in 0..8 {
            let inside = (0..nx * ny * nz).map(|i| pcg4d([seed, i as u32, 0, 0])[0] % 97 <= seed).collect();
            let mask = Mask { size, spacing_mm, inside };
            let map = DistanceMap::to(&mask).unwrap();
            for i in 0..mask.inside.len() {
                let nearest = mask.voxels().map(|v| position(v).distance(position(i))).fold(f64::INFINITY, f64::min);
                assert!((f64::from(map.at_mm(i)) - nearest).abs() < 1e-5, "voxel {i}, seed {seed}");
            }
        }
    }

    #[test]
    fn nothing_has_no_distance() {
        assert!(DistanceMap::to(&drawn([3; 3], DVec3::ONE, |_| false)).is_none());
    }
}
