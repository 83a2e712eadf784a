//! Attenuation volumes: the procedural thorax, a real CT, and vessels drawn into voxels.

use crate::formats::volume::Volume;
use crate::tree::{Bounds, Heart, Tree};
use glam::DVec3;
use rayon::prelude::*;

/// Attenuation of tissues, 1/mm.
#[derive(Debug, Clone, Copy)]
pub struct Tissues {
    /// Muscle, blood, liver.
    pub soft: f64,
    /// Inflated lung.
    pub lung: f64,
    /// Ribs and spine.
    pub bone: f64,
    /// Contrast-filled vessel.
    pub vessel: f64,
}

impl Tissues {
    /// XCAT volumes: 0.01, 0.003, 0.025 and 0.15 per 100 mm.
    pub const XCAT: Tissues = Tissues { soft: 1e-4, lung: 3e-5, bone: 2.5e-4, vessel: 1.5e-3 };
    /// MAGIX volumes: HU through mu = HU/1000 (mu_w - mu_a) + mu_w, scaled; vessels up to 0.05 per 100 mm.
    pub const MAGIX: Tissues = Tissues { soft: 3.8e-5, lung: 1.5e-5, bone: 5.5e-5, vessel: 5e-4 };
}

/// Number of background voxels along the left-right axis of the volume; voxels are cubes.
const BACKGROUND_VOXELS: usize = 128;

/// Makes a box of half sides `half_mm` around `centre` (LPS mm) from a function of position.
fn fill(centre: DVec3, half_mm: DVec3, value: impl Fn(DVec3) -> f64 + Sync) -> Volume {
    let spacing = 2.0 * half_mm.x / BACKGROUND_VOXELS as f64;
    let size @ [nx, ny, nz] = half_mm.to_array().map(|half| (2.0 * half / spacing).round() as usize);
    let mut volume = Volume::centred(size, spacing, centre, vec![0.0; nx * ny * nz]);
    let to_lps = volume.index_to_lps;
    volume.values.par_chunks_mut(nx).enumerate().for_each(|(row, values)| {
        let (y, z) = (row % ny, row / ny);
        for (x, v) in values.iter_mut().enumerate() {
            *v = value(to_lps.transform_point3(DVec3::new(x as f64, y as f64, z as f64))) as f32;
        }
    });
    volume
}

/// Smooth step across a surface: 1 inside (`distance` < 0), 0 outside, over `width`.
fn soft_edge(distance: f64, width: f64) -> f64 {
    (0.5 - distance / width).clamp(0.0, 1.0)
}

/// Signed, roughly metric distance to an ellipsoid.
fn ellipsoid(p: DVec3, centre: DVec3, radii: DVec3) -> f64 {
    let q = (p - centre) / radii;
    (q.length() - 1.0) * radii.min_element()
}

/// Static part of a thorax: body, lungs, ribs, spine. `scale` scales the anatomy around the heart at `heart_mm`. The volume is a
/// box of half sides `half_mm` around `centre_mm`; nothing attenuates outside it.
pub fn thorax(tissues: Tissues, heart_mm: DVec3, scale: f64, centre_mm: DVec3, half_mm: DVec3) -> Volume {
    let edge = 3.0 * scale;
    fill(centre_mm, half_mm, |lps| {
        // Anatomical coordinates, mm; the heart lies to the left of the spine and in front of it.
        let p = (lps - heart_mm) / scale + DVec3::new(25.0, -25.0, 0.0);
        let torso = (p.truncate() / glam::DVec2::new(165.0, 115.0)).length();
        let body = soft_edge((torso - 1.0) * 115.0, edge);
        let lung = |side: f64| {
            let d = ellipsoid(p, DVec3::new(side * 72.0, 5.0, 20.0), DVec3::new(62.0, 88.0, 135.0));
            let medial = 18.0 + 22.0 * f64::from(u8::from(side > 0.0 && p.z < 20.0)) - side * p.x;
            soft_edge(d.max(medial), edge)
        };
        let air = lung(-1.0).max(lung(1.0));
        let spine = soft_edge(
            ((p - DVec3::new(0.0, 72.0, p.z)).length() - 17.0).max(4.0 - (p.z.rem_euclid(28.0) - 14.0).abs() - 10.0),
            edge,
        );
        // Ribs slope down from the spine to the sternum on an elliptic cage.
        let cage = ((p.truncate() / glam::DVec2::new(138.0, 98.0)).length() - 1.0).abs() * 98.0;
        let level = (p.z + 0.32 * (90.0 - p.y)).rem_euclid(26.0) - 13.0;
        let rib = soft_edge((cage / 3.5).hypot(level / 5.5) * 4.0 - 4.0, edge);
        let rib = if p.y < -85.0 && p.x.abs() < 25.0 { 0.0 } else { rib };
        let soft = tissues.soft + (tissues.lung - tissues.soft) * air;
        body * (soft + (tissues.bone - soft) * rib.max(spine))
    })
}

/// Displacement of parts of the chest by breathing, LPS mm.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Breath {
    /// Displacement of the heart, including its vessels.
    pub heart_mm: DVec3,
    /// Displacement of the diaphragm and the organs in contact with it.
    pub chest_mm: DVec3,
}

/// Moving parts relative to [`thorax`]: heart and diaphragm displace lung. `squeeze` is the heart's contraction.
pub fn heart_and_diaphragm(
    tissues: Tissues,
    heart: &Heart,
    squeeze: f64,
    breath: Breath,
    heart_mm: DVec3,
    scale: f64,
    still: &Volume,
) -> Volume {
    let (to_lps, [nx, ny, _]) = (still.index_to_lps, still.size);
    let mut volume = Volume { values: vec![0.0; still.values.len()], ..still.clone() };
    volume.values.par_chunks_mut(nx).enumerate().for_each(|(row, values)| {
        let (y, z) = (row % ny, row / ny);
        for (x, v) in values.iter_mut().enumerate() {
            let here = f64::from(still.values[row * nx + x]);
            let lps = to_lps.transform_point3(DVec3::new(x as f64, y as f64, z as f64));
            let p = (lps - breath.chest_mm - heart_mm) / scale + DVec3::new(25.0, -25.0, 0.0);
            let dome = p.z + 62.0 + 0.0022 * (p.x.abs() - 70.0).powi(2);
            let solid = heart.contains(lps - breath.heart_mm, squeeze) || dome < 0.0;
            if solid && here > 0.0 && here < tissues.soft {
                *v = (tissues.soft - here) as f32;
            }
        }
    });
    volume
}

/// Range of height over which the breathing motion fades, from the diaphragm to the upper chest, mm above the isocentre.
const BREATHING_HEIGHT_MM: std::ops::Range<f64> = -40.0..40.0;
/// Range of depth over which the breathing motion fades, from the heart to the spine and the back, mm behind the isocentre.
const BREATHING_DEPTH_MM: std::ops::Range<f64> = 20.0..60.0;

/// Smooth step from 1 below a range to 0 above it.
fn fading(x: f64, range: &std::ops::Range<f64>) -> f64 {
    let t = ((x - range.start) / (range.end - range.start)).clamp(0.0, 1.0);
    1.0 - t * t * (3.0 - 2.0 * t)
}

/// Displaces the lower part of a chest around the isocentre by `chest_mm` (LPS), as breathing does: fully below 40 mm under the
/// isocentre, not at all above 40 mm over it or beyond 60 mm behind it, smoothly in between.
pub fn breathing_chest(chest: &Volume, chest_mm: DVec3) -> Volume {
    if chest_mm == DVec3::ZERO {
        return chest.clone();
    }
    let to_index = chest.index_to_lps.inverse();
    let [nx, ny, _] = chest.size;
    let mut volume = chest.clone();
    volume.values.par_chunks_mut(nx).enumerate().for_each(|(row, values)| {
        let (y, z) = (row % ny, row / ny);
        for (x, v) in values.iter_mut().enumerate() {
            let lps = chest.index_to_lps.transform_point3(DVec3::new(x as f64, y as f64, z as f64));
            let carried = fading(lps.z, &BREATHING_HEIGHT_MM) * fading(lps.y, &BREATHING_DEPTH_MM);
            if carried > 0.0 {
                *v = chest.interpolated(to_index.transform_point3(lps - chest_mm * carried));
            }
        }
    });
    volume
}

/// Converts Hounsfield units to attenuation per mm: mu = 0.02 max(0, 1 + HU / 1000), a usual value at 60 to 70 keV.
pub fn attenuation_from_hounsfield(volume: &mut Volume) {
    for v in &mut volume.values {
        *v = 0.02 * (1.0 + *v / 1000.0).max(0.0);
    }
}

/// Number of voxels along each axis of the grid that a tree within a box is drawn into.
pub(super) fn grid_size(bounds: Bounds, spacing_mm: f64) -> [usize; 3] {
    let (low, high) = (bounds.low_mm - 2.0 * spacing_mm, bounds.high_mm + 2.0 * spacing_mm);
    ((high - low) / spacing_mm).ceil().as_usizevec3().to_array().map(|n| n.saturating_add(1))
}

/// Draws a tree into the voxels of a box: attenuation times filling inside, antialiased at the wall.
pub fn vessels(tree: &Tree, bounds: Bounds, attenuation: f64, spacing_mm: f64) -> Volume {
    let low = bounds.low_mm - 2.0 * spacing_mm;
    let size = grid_size(bounds, spacing_mm);
    let mut values = vec![0f32; size.iter().product()];
    for branch in &tree.branches {
        let points = &branch.points;
        for i in 0..points.len().saturating_sub(1) {
            let ends = [(points[i] - low) / spacing_mm, (points[i + 1] - low) / spacing_mm];
            let radii = [branch.radius_mm[i] / spacing_mm, branch.radius_mm[i + 1] / spacing_mm];
            let filling = [branch.filling[i], branch.filling[i + 1]];
            draw_segment(&mut values, size, ends, radii, filling, attenuation);
        }
    }
    let translation = low;
    Volume {
        size,
        values,
        index_to_lps: glam::DAffine3::from_mat3_translation(
            glam::DMat3::from_diagonal(DVec3::splat(spacing_mm)),
            translation,
        ),
    }
}

/// Draws a tapering capsule between two points in voxel units; where capsules overlap, the largest value is kept.
fn draw_segment(
    values: &mut [f32],
    size: [usize; 3],
    ends: [DVec3; 2],
    radii: [f64; 2],
    filling: [f64; 2],
    attenuation: f64,
) {
    let reach = radii[0].max(radii[1]) + 1.0;
    let low = (ends[0].min(ends[1]) - reach).floor().max(DVec3::ZERO);
    let high = (ends[0].max(ends[1]) + reach).ceil();
    let axis = ends[1] - ends[0];
    let length2 = axis.length_squared().max(1e-12);
    let last = |h: f64, n: usize| (h as usize).min(n - 1);
    for z in low.z as usize..=last(high.z, size[2]) {
        for y in low.y as usize..=last(high.y, size[1]) {
            for x in low.x as usize..=last(high.x, size[0]) {
                let p = DVec3::new(x as f64, y as f64, z as f64);
                let t = ((p - ends[0]).dot(axis) / length2).clamp(0.0, 1.0);
                let radius = radii[0] + (radii[1] - radii[0]) * t;
                let coverage = soft_edge(p.distance(ends[0] + axis * t) - radius, 1.0);
                let value = (attenuation * coverage * (filling[0] + (filling[1] - filling[0]) * t)) as f32;
                let slot = &mut values[(z * size[1] + y) * size[0] + x];
                *slot = slot.max(value);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn breathing_carries_the_lower_chest_and_leaves_the_rest() {
        let n = 40;
        let flat = Volume::centred([n; 3], 5.0, DVec3::ZERO, vec![0.0; n * n * n]);
        // The value of each voxel is its height.
        let height = |i: usize| flat.index_to_lps.transform_point3(DVec3::new(0.0, 0.0, (i / (n * n)) as f64)).z;
        let chest = Volume { values: (0..n * n * n).map(|i| height(i) as f32).collect(), ..flat.clone() };
        let breathed = breathing_chest(&chest, DVec3::new(0.0, 0.0, 3.0));
        let moved = |lps: DVec3| {
            let at = flat.index_to_lps.inverse().transform_point3(lps);
            chest.interpolated(at) - breathed.interpolated(at)
        };
        assert!((moved(DVec3::new(10.0, -20.0, -60.0)) - 3.0).abs() < 1e-4, "the diaphragm goes along");
        let half = moved(DVec3::new(10.0, -20.0, 0.0));
        assert!((half - 1.5).abs() < 0.1, "the middle goes half the way: {half}");
        assert_eq!(moved(DVec3::new(10.0, -20.0, 60.0)), 0.0, "the upper chest stays");
        assert_eq!(moved(DVec3::new(10.0, 80.0, -60.0)), 0.0, "the spine stays");
    }

    #[test]
    fn a_straight_vessel_has_the_right_amount_of_contrast() {
        let branch = super::super::tree::Branch {
            name: "v".into(),
            points: vec![DVec3::new(-10.0, 0.3, 0.1), DVec3::new(10.0, -0.2, 0.4)],
            radius_mm: vec![1.5, 1.5],
            filling: vec![1.0, 1.0],
        };
        let tree = Tree { branches: vec![branch] };
        let volume = vessels(&tree, tree.bounds(), 0.1, 0.25);
        let total: f64 = volume.values.iter().map(|v| f64::from(*v)).sum::<f64>() * 0.25f64.powi(3);
        let length = DVec3::new(20.0, -0.5, 0.3).length();
        let exact =
            0.1 * (std::f64::consts::PI * 1.5 * 1.5 * length + 4.0 / 3.0 * std::f64::consts::PI * 1.5f64.powi(3));
        assert!((total / exact - 1.0).abs() < 0.02, "{total} against {exact}");
    }
}
