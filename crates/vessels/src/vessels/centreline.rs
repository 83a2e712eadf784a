//! Centrelines of sets of voxels: 3D thinning (Lee, Kashyap and Chu, CVGIP: Graphical Models 1994).
//!
//! Voxels of the surface are removed, those that face one of six directions at a time, if they are *simple*: if neither
//! components nor tunnels nor cavities appear, vanish or join. The end of a line stays. A voxel is simple if its neighbours
//! in the set are one component (26 neighbours), and so are the outside neighbours that share a face or an edge with it (6
//! neighbours; Bertrand and Malandain, Pattern Recognition Letters 1994).

use crate::vessels::mask::{CELLS, CENTRE, Framed, Mask, steps_to};

/// A set of the cells of a neighbourhood, one bit each.
type Cells = u32;

/// Cells that share a face with the centre, in the order in which the surfaces that face them are thinned: down and up each
/// axis in turn.
const FACES: [usize; 6] = [4, 22, 10, 16, 12, 14];

/// Cells within `steps` steps, at most one per axis, of another cell.
const fn within(cell: usize, steps: isize) -> Cells {
    let (from, mut cells, mut other) = (steps_to(cell), 0, 0);
    while other < CELLS {
        let to = steps_to(other);
        let (x, y, z) = ((to[0] - from[0]).abs(), (to[1] - from[1]).abs(), (to[2] - from[2]).abs());
        if other != cell && x <= 1 && y <= 1 && z <= 1 && x + y + z <= steps {
            cells |= 1 << other;
        }
        other += 1;
    }
    cells
}

/// Table of [`within`] for every cell.
const fn within_of_all(steps: isize) -> [Cells; CELLS] {
    let (mut all, mut cell) = ([0; CELLS], 0);
    while cell < CELLS {
        all[cell] = within(cell, steps);
        cell += 1;
    }
    all
}

const TOUCHING: [Cells; CELLS] = within_of_all(3);
const SHARING_A_FACE: [Cells; CELLS] = within_of_all(1);
/// Cells that share a face with the centre.
const AT_FACES: Cells = within(CENTRE, 1);
/// Cells that share a face or an edge with the centre.
const AT_FACES_OR_EDGES: Cells = within(CENTRE, 2);

/// Returns the cells of a set that are connected to `seed`.
fn connected(set: Cells, seed: Cells, neighbours: &[Cells; CELLS]) -> Cells {
    let (mut reached, mut new) = (seed, seed);
    while new != 0 {
        let cell = new.trailing_zeros() as usize;
        new &= new - 1;
        let further = neighbours[cell] & set & !reached;
        reached |= further;
        new |= further;
    }
    reached
}

/// Returns the lowest cell of a set.
fn any_of(set: Cells) -> Cells {
    set & set.wrapping_neg()
}

/// Tells whether the topology is unchanged without the voxel that has these neighbours in the set.
fn is_simple(neighbours: Cells) -> bool {
    let outside = !neighbours & AT_FACES_OR_EDGES;
    let at_faces = outside & AT_FACES;
    neighbours != 0
        && at_faces != 0
        && connected(neighbours, any_of(neighbours), &TOUCHING) == neighbours
        && connected(outside, any_of(at_faces), &SHARING_A_FACE) & at_faces == at_faces
}

/// Returns the centreline of a set: lines one voxel wide, with the set's components and tunnels. Around a cavity a surface
/// remains.
pub fn centreline(mask: &Mask) -> Mask {
    let mut thinning = Thinning::new(mask);
    while thinning.one_layer() {}
    let inside = (0..mask.inside.len())
        .map(|index| mask.inside[index] && thinning.left.inside[thinning.left.index_of(mask, index)])
        .collect();
    Mask { inside, ..*mask }
}

struct Thinning {
    left: Framed,
    offsets: [isize; CELLS],
    /// Voxels that share a face with the outside, including those already removed.
    surface: Vec<usize>,
    on_surface: Vec<bool>,
}

impl Thinning {
    fn new(mask: &Mask) -> Thinning {
        let left = mask.framed();
        let offsets = left.offsets();
        let on_surface = vec![false; left.inside.len()];
        let mut thinning = Thinning { left, offsets, surface: Vec::new(), on_surface };
        for index in mask.voxels() {
            let voxel = thinning.left.index_of(mask, index);
            if FACES.iter().any(|face| !thinning.is_inside(voxel, *face)) {
                thinning.note_surface(voxel);
            }
        }
        thinning
    }

    fn neighbour(&self, voxel: usize, cell: usize) -> usize {
        voxel.wrapping_add_signed(self.offsets[cell])
    }

    fn is_inside(&self, voxel: usize, cell: usize) -> bool {
        self.left.inside[self.neighbour(voxel, cell)]
    }

    fn note_surface(&mut self, voxel: usize) {
        if !std::mem::replace(&mut self.on_surface[voxel], true) {
            self.surface.push(voxel);
        }
    }

    fn neighbours(&self, voxel: usize) -> Cells {
        let cells = (0..CELLS).filter(|cell| *cell != CENTRE && self.is_inside(voxel, *cell));
        cells.fold(0, |cells, cell| cells | 1 << cell)
    }

    /// Removes the removable voxels of the surface, and tells whether there were any.
    fn one_layer(&mut self) -> bool {
        let before = self.surface.len();
        let mut gone = 0;
        for face in FACES {
            let removable = |voxel: &usize| {
                let facing = self.left.inside[*voxel] && !self.is_inside(*voxel, face);
                let neighbours = if facing { self.neighbours(*voxel) } else { 0 };
                neighbours.count_ones() > 1 && is_simple(neighbours)
            };
            let candidates: Vec<usize> = self.surface[..before].iter().copied().filter(removable).collect();
            // The removal of earlier candidates may have changed this voxel's neighbourhood.
            for voxel in candidates {
                if is_simple(self.neighbours(voxel)) {
                    self.left.inside[voxel] = false;
                    gone += 1;
                    for face in FACES {
                        if self.is_inside(voxel, face) {
                            self.note_surface(self.neighbour(voxel, face));
                        }
                    }
                }
            }
        }
        self.surface.retain(|voxel| self.left.inside[*voxel]);
        self.surface.sort_unstable();
        gone > 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::pcg4d;
    use crate::vessels::distances::DistanceMap;
    use crate::vessels::mask::component_sizes;
    use crate::vessels::mask::tests::drawn;
    use glam::DVec3;

    /// Euler number of a set's cells: vertices - edges + faces - cubes, which is components - tunnels + cavities.
    fn euler_number(mask: &Mask) -> i64 {
        let framed = mask.framed();
        let offsets = framed.offsets();
        // Each element belongs to the lowest corner of the cells that contain it; 26-connected sets consist of closed
        // cells.
        let mut number = 0;
        for voxel in 0..framed.inside.len() {
            for element in 0..8usize {
                let steps: [isize; 3] = std::array::from_fn(|axis| (element >> axis & 1) as isize);
                let sharing = (0..CELLS).filter(|cell| {
                    steps_to(*cell)
                        .iter()
                        .zip(steps)
                        .all(|(s, spread)| if spread == 1 { (-1..=0).contains(s) } else { *s == 0 })
                });
                let inside = sharing.map(|cell| voxel.checked_add_signed(offsets[cell]));
                let any = { inside }.any(|at| at.is_some_and(|at| framed.inside.get(at).copied().unwrap_or(false)));
                // Cube (no spread) -1, face +1, edge -1, vertex +1.
                let sign = if steps.iter().sum::<isize>() % 2 == 1 { 1 } else { -1 };
                number += sign * i64::from(any);
            }
        }
        number
    }

    #[test]
    fn a_straight_vessel_becomes_its_middle() {
        let vessel =
            drawn([41, 15, 15], DVec3::ONE, |p| (3.0..38.0).contains(&p.x) && (p.y - 7.0).hypot(p.z - 7.0) < 4.2);
        let line = centreline(&vessel);
        let middle = drawn(vessel.size, DVec3::ONE, |p| (3.0..38.0).contains(&p.x) && p.y == 7.0 && p.z == 7.0);
        let (to_line, to_middle) = (DistanceMap::to(&line).unwrap(), DistanceMap::to(&middle).unwrap());
        assert!(line.voxels().all(|v| to_middle.at_mm(v) <= 1.0), "a line of the middle alone");
        let length = line.voxels().count();
        // Thinning shortens ends by at most the radius.
        assert!((27..=38).contains(&length), "{length} voxels of a line of 35");
        let near = middle.voxels().filter(|v| to_line.at_mm(*v) <= 1.0).count();
        assert!(near >= 27, "{near} of 35 voxels of the middle have a line");
    }

    #[test]
    fn a_torus_stays_one_ring() {
        let torus = drawn([31, 31, 11], DVec3::ONE, |p| ((p - 15.0).truncate().length() - 10.0).hypot(p.z - 5.0) < 3.2);
        let ring = centreline(&torus);
        assert_eq!((component_sizes(&ring).len(), euler_number(&ring)), (1, 0));
        let count = ring.voxels().count() as f64;
        let circle = std::f64::consts::TAU * 10.0;
        assert!((0.75 * circle..1.1 * circle).contains(&count), "{count} voxels for a circle of {circle:.0}");
    }

    #[test]
    fn a_ball_becomes_a_point_and_a_shell_stays_closed() {
        let distance = |p: DVec3| p.distance(DVec3::splat(9.0));
        let ball = centreline(&drawn([19; 3], DVec3::ONE, |p| distance(p) < 7.5));
        assert!(ball.voxels().count() <= 3, "{}", ball.voxels().count());
        let shell = centreline(&drawn([19; 3], DVec3::ONE, |p| (5.0..7.5).contains(&distance(p))));
        assert_eq!(euler_number(&shell), 2, "a cavity stays a cavity");
    }

    #[test]
    fn topology_stays() {
        for seed in 0..20 {
            let mut voxel = 0;
            let mut mask = drawn([12; 3], DVec3::ONE, |_| false);
            mask.inside.fill_with(|| {
                voxel += 1;
                pcg4d([seed, voxel, 0, 0])[0] % 10 <= seed % 9
            });
            let line = centreline(&mask);
            assert!(line.inside.iter().zip(&mask.inside).all(|(line, mask)| *mask || !*line));
            assert_eq!(component_sizes(&line).len(), component_sizes(&mask).len(), "components, seed {seed}");
            assert_eq!(euler_number(&line), euler_number(&mask), "tunnels and cavities, seed {seed}");
        }
    }
}
