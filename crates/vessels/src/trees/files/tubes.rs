//! Conversion of trees to tubes with the vessels' radii.

use crate::error::Result;
use crate::formats::gltf::{self, MovingMesh};
use crate::formats::mesh::Mesh;
use crate::trees::tree::{BeatTree, Branch, PhaseTree};
use glam::{DQuat, DVec3};
use std::f64::consts::TAU;

/// Number of vertices of a ring.
const CORNERS: usize = 16;

/// Writes the tubes of all branches as one binary glTF, in metres, with the beat as its animation. Where points are
/// followed, each branch is a mesh whose shape is interpolated linearly between phases; otherwise each phase is a mesh that
/// is shown for its share of the beat. A tube has a ring of 16 vertices around each point, at the distance of its radius,
/// followed by two flat caps.
///
/// # Errors
/// [`crate::error::Error::Internal`] for values that JSON cannot represent.
pub(super) fn to_glb(beat: &BeatTree) -> Result<Vec<u8>> {
    let Some(first) = beat.phases.first().filter(|_| beat.reference_phase.is_some()) else {
        let all = |tree: &PhaseTree| (tree.phase, joined(tree.branches.iter().map(|b| tube(b, &around(&b.points_mm)))));
        return Ok(gltf::to_glb(&beat.phases.iter().map(all).collect::<Vec<_>>())?);
    };
    let part = |(index, rest): (usize, &Branch)| {
        let (directions, rest_around) = (directions(&rest.points_mm), around(&rest.points_mm));
        let at = |tree: &PhaseTree| {
            let branch = &tree.branches[index];
            tube(branch, &turned(&rest_around, &directions, &branch.points_mm))
        };
        MovingMesh { name: format!("branch {index}"), phases: beat.phases.iter().map(at).collect() }
    };
    let parts: Vec<MovingMesh> = first.branches.iter().enumerate().map(part).collect();
    Ok(gltf::to_moving_glb(&parts)?)
}

/// Direction of a line at each of its points.
fn directions(points_mm: &[DVec3]) -> Vec<DVec3> {
    let last = points_mm.len() - 1;
    let at = |i: usize| points_mm[(i + 1).min(last)] - points_mm[i.saturating_sub(1)];
    let mut before = DVec3::Z;
    (0..points_mm.len())
        .map(|i| {
            before = at(i).normalize_or(before);
            before
        })
        .collect()
}

/// Direction to the first vertex of the ring around each point of a line: across the line, with the minimum rotation from
/// one point to the next.
fn around(points_mm: &[DVec3]) -> Vec<DVec3> {
    let directions = directions(points_mm);
    let mut across = directions[0].any_orthonormal_vector();
    let mut before = directions[0];
    directions
        .into_iter()
        .map(|direction| {
            across = DQuat::from_rotation_arc(before, direction) * across;
            before = direction;
            across
        })
        .collect()
}

/// Directions to the first vertices after the line has moved, with the minimum rotation.
fn turned(rest_around: &[DVec3], rest_directions: &[DVec3], points_mm: &[DVec3]) -> Vec<DVec3> {
    let turn = |((across, from), to): ((&DVec3, &DVec3), DVec3)| DQuat::from_rotation_arc(*from, to) * *across;
    rest_around.iter().zip(rest_directions).zip(directions(points_mm)).map(turn).collect()
}

/// Creates the closed tube of a branch, with rings that begin at `around`.
fn tube(branch: &Branch, around: &[DVec3]) -> Mesh {
    let rings = branch.points_mm.len();
    let directions = directions(&branch.points_mm);
    let mut mesh = Mesh::default();
    let mut add = |place: DVec3, normal: DVec3| {
        mesh.vertices.push(place.as_vec3().to_array());
        mesh.normals.push(normal.as_vec3().to_array());
    };
    let corner = |ring: usize, k: usize| {
        let (sine, cosine) = (TAU * k as f64 / CORNERS as f64).sin_cos();
        let outwards = cosine * around[ring] + sine * directions[ring].cross(around[ring]);
        (branch.points_mm[ring] + branch.radius_mm[ring] * outwards, outwards)
    };
    for (ring, k) in (0..rings).flat_map(|ring| (0..CORNERS).map(move |k| (ring, k))) {
        let (place, outwards) = corner(ring, k);
        add(place, outwards);
    }
    // Caps have their own vertices, with normals along the line.
    for (ring, normal) in [(0, -directions[0]), (rings - 1, directions[rings - 1])] {
        (0..CORNERS).for_each(|k| add(corner(ring, k).0, normal));
        add(branch.points_mm[ring], normal);
    }
    mesh.triangles = triangles(rings);
    mesh
}

/// Triangles of a tube, counter-clockwise from outside.
fn triangles(rings: usize) -> Vec<[u32; 3]> {
    let next = |k: usize| (k + 1) % CORNERS;
    let of_side = |ring: usize, k: usize| {
        let here = |k: usize| (ring * CORNERS + k) as u32;
        let there = |k: usize| ((ring + 1) * CORNERS + k) as u32;
        [[here(k), here(next(k)), there(k)], [here(next(k)), there(next(k)), there(k)]]
    };
    let sides = (0..rings - 1).flat_map(|ring| (0..CORNERS).flat_map(move |k| of_side(ring, k)));
    let of_cap = |cap: usize, k: usize| {
        let first = rings * CORNERS + cap * (CORNERS + 1);
        let [a, b, middle] = [first + k, first + next(k), first + CORNERS].map(|i| i as u32);
        if cap == 0 { [middle, b, a] } else { [middle, a, b] }
    };
    sides.chain((0..2).flat_map(|cap| (0..CORNERS).map(move |k| of_cap(cap, k)))).collect()
}

/// Joins meshes to one.
fn joined(meshes: impl Iterator<Item = Mesh>) -> Mesh {
    meshes.fold(Mesh::default(), |mut all, mesh| {
        let first = all.vertices.len() as u32;
        all.vertices.extend(mesh.vertices);
        all.normals.extend(mesh.normals);
        all.triangles.extend(mesh.triangles.into_iter().map(|t| t.map(|i| i + first)));
        all
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    /// A bent vessel that becomes narrower.
    fn bent(turn: f64) -> Branch {
        let point = |i: usize| {
            let angle = turn * i as f64 / 40.0;
            20.0 * DVec3::new(angle.cos(), angle.sin(), 0.3 * angle)
        };
        Branch {
            parent: None,
            points_mm: (0..=40).map(point).collect(),
            radius_mm: (0..=40).map(|i| 2.0 - 0.02 * f64::from(i)).collect(),
            agreement: Vec::new(),
            doubt: Vec::new(),
            gap_mm: 0.0,
        }
    }

    #[test]
    fn a_tube_is_closed_and_has_its_radius() {
        let branch = bent(3.0);
        let mesh = tube(&branch, &around(&branch.points_mm));
        for (ring, vertices) in mesh.vertices.chunks(CORNERS).take(branch.points_mm.len()).enumerate() {
            for vertex in vertices {
                let away = Vec3::from(*vertex).as_dvec3().distance(branch.points_mm[ring]);
                assert!((away - branch.radius_mm[ring]).abs() < 1e-5, "{away} mm at ring {ring}");
            }
        }
        // The area of a ring's polygon of 16 vertices is slightly smaller than a circle's.
        let share = CORNERS as f64 / TAU * (TAU / CORNERS as f64).sin();
        let area = |r: f64| share * std::f64::consts::PI * r * r;
        let length = branch.length_mm();
        let expected: f64 = branch.radius_mm.windows(2).map(|r| area(0.5 * (r[0] + r[1])) * length / 40.0).sum();
        assert!((mesh.volume_mm3() / expected - 1.0).abs() < 0.02, "{} mm³ for {expected}", mesh.volume_mm3());
        for triangle in &mesh.triangles {
            let [a, b, c] = triangle.map(|i| Vec3::from(mesh.vertices[i as usize]));
            let normal = Vec3::from(mesh.normals[triangle[0] as usize]);
            assert!((b - a).cross(c - a).dot(normal) > 0.0, "triangles face as their normals do");
        }
    }

    #[test]
    fn rings_of_a_vessel_that_moves_do_not_twist() {
        let (rest, moved) = (bent(3.0), bent(3.3));
        let rest_around = around(&rest.points_mm);
        let moved_around = turned(&rest_around, &directions(&rest.points_mm), &moved.points_mm);
        for ((a, b), direction) in rest_around.iter().zip(&moved_around).zip(directions(&moved.points_mm)) {
            assert!(a.angle_between(*b) < 0.35, "{} rad", a.angle_between(*b));
            assert!(b.dot(direction).abs() < 1e-9 && (b.length() - 1.0).abs() < 1e-9, "across the line");
        }
    }
}
