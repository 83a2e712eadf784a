//! Interpolation of the dynamic field between the points of a grid.

use crate::render::grid::PatientGrid;
use glam::DVec3;

/// Attenuation at the points of a grid, per mm; zero beyond it.
pub(super) struct SampledField {
    pub(super) grid: PatientGrid,
    pub(super) values: Vec<f32>,
}

/// Catmull-Rom weights of the four points around a position at the share `t` between the second and the third.
fn cubic(t: f64) -> [f64; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [0.5 * (2.0 * t2 - t - t3), 0.5 * (3.0 * t3 - 5.0 * t2 + 2.0), 0.5 * (4.0 * t2 + t - 3.0 * t3), 0.5 * (t3 - t2)]
}

impl SampledField {
    /// Attenuation at a position, per mm; cubic along each axis, and never below 0.
    pub(super) fn at(&self, place_mm: DVec3) -> f64 {
        let [nx, ny, nz] = self.grid.size.map(|n| n as isize);
        let index = (place_mm - self.grid.origin_mm) / self.grid.spacing_mm;
        let first = index.floor();
        let weights = (index - first).to_array().map(cubic);
        let [x0, y0, z0] = first.to_array().map(|i| i as isize - 1);
        let mut sum = 0.0;
        for (dz, wz) in weights[2].iter().enumerate() {
            for (dy, wy) in weights[1].iter().enumerate() {
                let (y, z) = (y0 + dy as isize, z0 + dz as isize);
                if !(0..ny).contains(&y) || !(0..nz).contains(&z) {
                    continue;
                }
                for (dx, wx) in weights[0].iter().enumerate() {
                    let x = x0 + dx as isize;
                    if (0..nx).contains(&x) {
                        sum += wx * wy * wz * f64::from(self.values[((z * ny + y) * nx + x) as usize]);
                    }
                }
            }
        }
        sum.max(0.0)
    }

    /// Position of a point of the grid, mm.
    pub(super) fn place_mm(&self, index: usize) -> DVec3 {
        let [nx, ny, _] = self.grid.size.map(|n| n as usize);
        let steps = DVec3::new((index % nx) as f64, (index / nx % ny) as f64, (index / (nx * ny)) as f64);
        self.grid.origin_mm + steps * self.grid.spacing_mm
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Distance between points of the grids of tests, mm.
    pub(in crate::trees) const SPACING_MM: f64 = 0.5;
    /// Resolution of test fields, mm.
    pub(in crate::trees) const RESOLUTION_MM: f64 = 2.0 * SPACING_MM;
    /// Attenuation inside test vessels.
    pub(in crate::trees) const VESSEL_PER_MM: f64 = 0.02;

    /// A test vessel: a line, and a radius in mm.
    pub(in crate::trees) type Tube = (Vec<DVec3>, f64);

    /// Points along a line, mm.
    pub(in crate::trees) fn points(n: usize, at: impl Fn(f64) -> DVec3) -> Vec<DVec3> {
        (0..=n).map(|i| at(i as f64 / n as f64)).collect()
    }

    /// Distance of a position from the nearest point of a line, mm.
    pub(in crate::trees) fn distance_mm(line: &[DVec3], place: DVec3) -> f64 {
        line.iter().map(|p| p.distance(place)).fold(f64::INFINITY, f64::min)
    }

    /// Vessels with soft walls in a cube of 40 mm around the origin; they do not reach its faces.
    pub(in crate::trees) fn vessels(tubes: &[Tube]) -> SampledField {
        const N: u32 = 81;
        let grid = PatientGrid {
            origin_mm: DVec3::splat(-0.5 * f64::from(N - 1) * SPACING_MM),
            spacing_mm: DVec3::splat(SPACING_MM),
            size: [N; 3],
        };
        let mut field = SampledField { grid, values: vec![0.0; (N as usize).pow(3)] };
        for (line, radius_mm) in tubes {
            let reach = ((radius_mm + RESOLUTION_MM) / SPACING_MM).ceil() as i64;
            let around = || -reach..=reach;
            for point in line {
                let [x, y, z] = ((*point - grid.origin_mm) / SPACING_MM).round().as_i64vec3().to_array();
                for (dz, dy) in around().flat_map(|dz| around().map(move |dy| (dz, dy))) {
                    for dx in around() {
                        let index = ((((z + dz) * i64::from(N)) + y + dy) * i64::from(N) + x + dx) as usize;
                        let beyond = (point.distance(field.place_mm(index)) - radius_mm) / RESOLUTION_MM;
                        let value = VESSEL_PER_MM * (0.5 - beyond).clamp(0.0, 1.0);
                        field.values[index] = field.values[index].max(value as f32);
                    }
                }
            }
        }
        field
    }

    #[test]
    fn between_points_a_cubic_is_itself() {
        let size = [8, 7, 9];
        let grid = PatientGrid { origin_mm: DVec3::new(-1.0, 2.0, 0.5), spacing_mm: DVec3::new(0.5, 1.0, 2.0), size };
        let quadratic = |p: DVec3| 40.0 + p.x * p.y - 2.0 * p.z + 0.5 * p.x * p.x;
        let mut field = SampledField { grid, values: vec![0.0; 8 * 7 * 9] };
        for index in 0..field.values.len() {
            field.values[index] = quadratic(field.place_mm(index)) as f32;
        }
        for place in [DVec3::new(0.3, 4.2, 6.9), DVec3::new(1.49, 5.5, 3.1), DVec3::new(0.0, 4.0, 4.5)] {
            assert!((field.at(place) - quadratic(place)).abs() < 1e-4, "{} at {place}", field.at(place));
        }
        assert_eq!(field.at(DVec3::splat(1e4)), 0.0);
    }
}
