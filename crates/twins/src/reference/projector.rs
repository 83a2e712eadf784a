//! f64 projector, independent of the device's, with the device's sampling rule in plain loops.

use crate::formats::volume::Volume;
use crate::geometry::{MM_PER_UNIT, ViewRays, world_to_index};
use glam::DVec3;
use nertca_vk_phantom::projector::{bounding_radius, depth_steps};

/// Trilinear value at a voxel index; zero outside.
pub fn trilinear(volume: &Volume, index: DVec3) -> f64 {
    let base = index.floor();
    let f = index - base;
    let mut sum = 0.0;
    for corner in 0..8u32 {
        let mut weight = 1.0;
        let mut at = [0i64; 3];
        for axis in 0..3 {
            let up = corner >> axis & 1;
            weight *= if up == 1 { f[axis] } else { 1.0 - f[axis] };
            at[axis] = base[axis] as i64 + i64::from(up);
        }
        let [nx, ny, nz] = volume.size.map(|n| n as i64);
        if (0..nx).contains(&at[0]) && (0..ny).contains(&at[1]) && (0..nz).contains(&at[2]) {
            sum += weight * f64::from(volume.values[((at[2] * ny + at[1]) * nx + at[0]) as usize]);
        }
    }
    sum
}

/// Line integral of one pixel's ray, by the mid-points of equal depth steps of half a voxel.
pub fn project_pixel(volume: &Volume, rays: &ViewRays, column: usize, row: usize) -> f64 {
    let to_index = world_to_index(&volume.index_to_lps);
    let half = bounding_radius(volume).min(rays.sod);
    let steps = depth_steps(volume, half);
    let (anchor, direction) = rays.pixel(column as f64, row as f64);
    let depth_step = 2.0 * half / f64::from(steps);
    let sum: f64 = (0..steps)
        .map(|k| {
            let depth = -half + (f64::from(k) + 0.5) * depth_step;
            trilinear(volume, to_index.transform_point3(anchor + depth * direction))
        })
        .sum();
    sum * depth_step * direction.length() * MM_PER_UNIT
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CArm, Geometry};

    #[test]
    fn a_gaussian_blob_has_its_exact_integral() {
        let (n, spacing, sigma) = (64usize, 0.5, 4.0);
        let centre = (n as f64 - 1.0) / 2.0;
        let values = (0..n * n * n)
            .map(|i| {
                let p = DVec3::new((i % n) as f64, (i / n % n) as f64, (i / (n * n)) as f64) - centre;
                (-0.5 * (p * spacing).length_squared() / (sigma * sigma)).exp() as f32
            })
            .collect();
        let volume = Volume::centred([n; 3], spacing, DVec3::ZERO, values);
        let carm = CArm {
            primary_deg: 20.0,
            secondary_deg: -15.0,
            sid_mm: 1000.0,
            sod_mm: 700.0,
            pixel_mm: [1.0, 1.0],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        };
        let rays = Geometry::CArm(carm).rays(11, 11).unwrap();
        for (i, j) in [(5, 5), (2, 7)] {
            let (anchor, direction) = rays.pixel(i as f64, j as f64);
            let unit = direction.normalize();
            let miss = (anchor - unit * anchor.dot(unit)).length() * MM_PER_UNIT;
            let exact = (-0.5 * (miss / sigma).powi(2)).exp() * sigma * std::f64::consts::TAU.sqrt();
            let got = project_pixel(&volume, &rays, i, j);
            assert!((got / exact - 1.0).abs() < 5e-3, "{got} against {exact}");
        }
    }
}
