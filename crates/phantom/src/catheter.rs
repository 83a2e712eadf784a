//! A coronary catheter: it enters through the aorta, with its tip in the ostium.

use crate::formats::volume::Volume;
use crate::tree::{Branch, Tree, spline};
use crate::voxels;
use glam::DVec3;

/// Radius, mm: 6 French, which is a diameter of 2 mm.
const RADIUS_MM: f64 = 1.0;
/// Attenuation of wall and undiluted contrast as a multiple of that of a filled vessel.
const DENSITY: f64 = 2.0;
/// Course from the ostium, LPS mm: across the root of the aorta, up along its right wall, and out towards the neck.
const COURSE: &[[f64; 3]] = &[
    [0.0, 0.0, 0.0],
    [-9.0, 1.0, 3.0],
    [-17.0, 4.0, 14.0],
    [-18.0, 4.0, 40.0],
    [-14.0, 8.0, 75.0],
    [-26.0, 10.0, 110.0],
    [-34.0, 8.0, 150.0],
];
/// Number of intervals between points along the course.
const STEPS: usize = 120;

/// Draws a catheter whose tip is at `tip_mm` and whose course begins at `rest_mm` when the heart is at rest (LPS). The tip
/// moves with the heart, the rest of the catheter less with the distance from the tip, and the far end not at all. `scale`
/// scales the catheter with the anatomy.
pub(super) fn volume(tip_mm: DVec3, rest_mm: DVec3, scale: f64, vessel_per_mm: f64, spacing_mm: f64) -> Volume {
    let point = |step: usize| {
        let along = step as f64 / STEPS as f64;
        let carried = (tip_mm - rest_mm) * (1.0 - along).powi(3);
        rest_mm + DVec3::from_array(spline(COURSE, along)) * scale + carried
    };
    let branch = Branch {
        name: "catheter".to_owned(),
        points: (0..=STEPS).map(point).collect(),
        radius_mm: vec![RADIUS_MM * scale; STEPS + 1],
        filling: vec![DENSITY; STEPS + 1],
    };
    let tree = Tree { branches: vec![branch] };
    voxels::vessels(&tree, tree.bounds(), vessel_per_mm, spacing_mm)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Attenuation of the voxel nearest to a point, LPS mm.
    fn attenuation(volume: &Volume, at: DVec3) -> f32 {
        let index = volume.index_to_lps.inverse().transform_point3(at).round().as_usizevec3();
        volume.values[(index.z * volume.size[1] + index.y) * volume.size[0] + index.x]
    }

    #[test]
    fn the_tip_moves_and_the_far_end_does_not() {
        let (rest, moved) = (DVec3::new(3.0, 10.0, 40.0), DVec3::new(0.0, 2.0, 8.0));
        let still = volume(rest, rest, 1.0, 0.1, 0.5);
        let carried = volume(rest + moved, rest, 1.0, 0.1, 0.5);
        let far = rest + DVec3::from_array(COURSE[COURSE.len() - 1]);
        for volume in [&still, &carried] {
            assert!((attenuation(volume, far) - 0.2).abs() < 1e-6, "its far end is dense and still");
        }
        assert!((attenuation(&still, rest) - 0.2).abs() < 1e-6);
        assert!((attenuation(&carried, rest + moved) - 0.2).abs() < 1e-6);
        assert_eq!(attenuation(&carried, rest), 0.0, "where the tip was");
        let mass = |volume: &Volume| volume.values.iter().map(|v| f64::from(*v)).sum::<f64>() * 0.125;
        let length = mass(&still) / (0.2 * std::f64::consts::PI);
        assert!((150.0..190.0).contains(&length), "2 mm wide and {length} mm long");
    }
}
