//! Filling of thick vessels: a field that is fitted to a vessel much wider than its resolution is uneven inside, and holes and tunnels in it
//! would become branches of the centreline.

use crate::raster::percentile;
use crate::trees::sampled::SampledField;
use crate::vessels::distances::DistanceMap;
use crate::vessels::mask::Mask;

// Numbers of this file: checked with straight tubes of 1.6 to 20 mm (docs/performance.md, tests/cli/wide_vessels.rs).
/// Radius of the holes that are closed in thick vessels, in units of the field's resolution.
const HOLE: f64 = 2.0;
/// Radius of the smallest ball that a thick vessel holds once its holes are closed, in units of the field's resolution.
const THICK: f64 = 2.5;
/// Percentile of the field inside thick vessels that is taken as their attenuation where it is not known.
const LEVEL_PERCENTILE: f64 = 0.75;

/// A set of voxels whose thick parts are solid.
#[derive(Debug, PartialEq)]
struct Solid {
    /// The set with the holes of its thick parts, and all cavities, filled.
    mask: Mask,
    /// Voxels of thick parts that lie deeper inside than the resolution.
    interior: Vec<bool>,
}

/// Fills a set of voxels. A part is thick if it holds a ball of [`THICK`] once holes are closed; gaps between thin vessels hold none, and
/// stay open.
fn solid(mask: &Mask, resolution_mm: f64) -> Solid {
    let (hole_mm, thick_mm) = (HOLE * resolution_mm, THICK * resolution_mm);
    let margin = mask.spacing_mm.to_array().map(|step| (hole_mm / step).ceil() as usize + 1);
    let wide = framed(mask, margin);
    let mut closed = within(&wide, hole_mm).complement();
    closed = within(&closed, hole_mm).complement();
    let core = within(&closed.complement(), thick_mm).complement();
    let thick = within(&core, thick_mm);
    let filled = Mask {
        inside: (0..wide.inside.len()).map(|v| wide.inside[v] || closed.inside[v] && thick.inside[v]).collect(),
        ..wide
    };
    let filled = without_cavities(filled);
    let deep = within(&filled.complement(), resolution_mm).complement();
    let interior =
        Mask { inside: deep.inside.iter().zip(&thick.inside).map(|(deep, thick)| *deep && *thick).collect(), ..deep };
    Solid { mask: unframed(&filled, mask, margin), interior: unframed(&interior, mask, margin).inside }
}

/// Makes the thick vessels of a field solid, and returns the voxels of all vessels. Without it, centrelines and radii of a thick vessel would
/// follow the lumps of the field. The interior gets the attenuation of vessels where it is known, and a high percentile of the field inside
/// thick vessels otherwise.
pub(super) fn make_solid(
    field: &mut SampledField,
    threshold_per_mm: f64,
    resolution_mm: f64,
    vessel_per_mm: Option<f64>,
) -> Mask {
    let inside: Vec<bool> = field.values.iter().map(|v| f64::from(*v) > threshold_per_mm).collect();
    let (size, spacing_mm) = (field.grid.size.map(|n| n as usize), field.grid.spacing_mm);
    let Solid { mask, interior } = solid(&Mask { size, spacing_mm, inside }, resolution_mm);
    let interior: Vec<usize> = (0..interior.len()).filter(|voxel| interior[*voxel]).collect();
    let level = vessel_per_mm.map_or_else(
        || percentile(&interior.iter().map(|voxel| field.values[*voxel]).collect::<Vec<_>>(), LEVEL_PERCENTILE),
        |per_mm| per_mm as f32,
    );
    interior.into_iter().for_each(|voxel| field.values[voxel] = level);
    mask
}

/// Returns the voxels within a distance of a set.
fn within(mask: &Mask, distance_mm: f64) -> Mask {
    let distance = DistanceMap::to(mask);
    let near = |voxel| distance.as_ref().is_some_and(|map| f64::from(map.at_mm(voxel)) <= distance_mm);
    Mask { inside: (0..mask.inside.len()).map(near).collect(), ..*mask }
}

/// Returns the set with a margin of so many outside voxels along each axis.
fn framed(mask: &Mask, margin: [usize; 3]) -> Mask {
    let size = [0, 1, 2].map(|axis| mask.size[axis] + 2 * margin[axis]);
    let mut wide = Mask { size, spacing_mm: mask.spacing_mm, inside: vec![false; size.iter().product()] };
    for voxel in mask.voxels() {
        let at = framed_index(mask, voxel, size, margin);
        wide.inside[at] = true;
    }
    wide
}

fn framed_index(mask: &Mask, voxel: usize, size: [usize; 3], margin: [usize; 3]) -> usize {
    let [nx, ny, _] = mask.size;
    let (x, y, z) = (voxel % nx + margin[0], voxel / nx % ny + margin[1], voxel / (nx * ny) + margin[2]);
    (z * size[1] + y) * size[0] + x
}

/// Returns the part of a framed set on the grid of `mask`.
fn unframed(wide: &Mask, mask: &Mask, margin: [usize; 3]) -> Mask {
    let inside = (0..mask.inside.len()).map(|voxel| wide.inside[framed_index(mask, voxel, wide.size, margin)]);
    Mask { inside: inside.collect(), ..*mask }
}

/// Returns a set that has outside voxels at the border of its grid with its cavities filled: outside voxels that no path of faces connects
/// to the first voxel of the grid.
fn without_cavities(mask: Mask) -> Mask {
    let [nx, ny, nz] = mask.size;
    let mut inside = vec![true; mask.inside.len()];
    let mut waiting = vec![0];
    while let Some(voxel) = waiting.pop() {
        if mask.inside[voxel] || !std::mem::replace(&mut inside[voxel], false) {
            continue;
        }
        let at = [voxel % nx, voxel / nx % ny, voxel / (nx * ny)];
        for (axis, (n, step)) in [(nx, 1), (ny, nx), (nz, nx * ny)].into_iter().enumerate() {
            if at[axis] > 0 {
                waiting.push(voxel - step);
            }
            if at[axis] + 1 < n {
                waiting.push(voxel + step);
            }
        }
    }
    Mask { inside, ..mask }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::vessels::mask::tests::drawn;
    use glam::DVec3;

    const RESOLUTION_MM: f64 = 2.0;
    const SPACING_MM: DVec3 = DVec3::ONE;

    /// A tube along z in the middle of a grid.
    fn is_in_tube(p: DVec3, radius_mm: f64) -> bool {
        (p - DVec3::new(20.0, 20.0, p.z)).length() < radius_mm && (5.0..45.0).contains(&p.z)
    }

    #[test]
    fn holes_of_a_thick_tube_are_filled() {
        let tube = |radius_mm: f64| drawn([41, 41, 50], SPACING_MM, |p| is_in_tube(p, radius_mm));
        // A cavity, and a tunnel across the tube.
        let is_hole = |p: DVec3| {
            p.distance(DVec3::new(17.0, 21.0, 15.0)) < 2.5 || (p - DVec3::new(p.x, 20.0, 30.0)).length() < 2.5
        };
        let holed = drawn([41, 41, 50], SPACING_MM, |p| is_in_tube(p, 10.0) && !is_hole(p));
        let Solid { mask: filled, interior } = solid(&holed, RESOLUTION_MM);
        assert!(holed.voxels().all(|voxel| filled.inside[voxel]), "nothing is removed");
        let missing = tube(8.0).voxels().filter(|voxel| !filled.inside[*voxel]).count();
        let beyond = filled.voxels().filter(|voxel| !tube(10.0).inside[*voxel]).count();
        assert_eq!((missing, beyond), (0, 0));
        let depths_mm = DistanceMap::to(&filled.complement()).unwrap();
        let is_deep = |voxel: usize| f64::from(depths_mm.at_mm(voxel)) > RESOLUTION_MM;
        assert!(tube(7.0).voxels().filter(|voxel| is_deep(*voxel)).count() > 5000);
        assert!((0..interior.len()).all(|voxel| !interior[voxel] || is_deep(voxel)), "the rim is not interior");
        assert!(tube(7.0).voxels().all(|voxel| interior[voxel] == is_deep(voxel)));
    }

    fn as_it_is(mask: &Mask) -> Solid {
        Solid { mask: mask.clone(), interior: vec![false; mask.inside.len()] }
    }

    #[test]
    fn gaps_between_thin_vessels_stay_open() {
        // Two vessels side by side, and a loop.
        let beside = drawn([41, 41, 50], SPACING_MM, |p| {
            is_in_tube(p + 3.0 * DVec3::X, 2.0) || is_in_tube(p - 3.0 * DVec3::X, 2.0)
        });
        assert_eq!(solid(&beside, RESOLUTION_MM), as_it_is(&beside));
        let ring = drawn([41, 41, 20], SPACING_MM, |p| {
            let away = (p - DVec3::new(20.0, 20.0, p.z)).length() - 6.0;
            away.hypot(p.z - 10.0) < 2.0
        });
        assert_eq!(solid(&ring, RESOLUTION_MM), as_it_is(&ring));
        let nothing = drawn([5, 5, 5], SPACING_MM, |_| false);
        assert_eq!(solid(&nothing, RESOLUTION_MM), as_it_is(&nothing));
    }
}
