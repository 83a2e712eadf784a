//! Sets of voxels of a regular grid.

use glam::DVec3;

/// A set of voxels of a regular grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Mask {
    /// Voxels along each axis; the first is the fastest in memory.
    pub size: [usize; 3],
    /// Distance of neighbours along each axis, mm.
    pub spacing_mm: DVec3,
    /// Whether each voxel belongs to the set.
    pub inside: Vec<bool>,
}

impl Mask {
    /// Volume of one voxel, mm³.
    pub fn voxel_mm3(&self) -> f64 {
        self.spacing_mm.element_product()
    }

    /// Indices of the voxels of the set.
    pub fn voxels(&self) -> impl Iterator<Item = usize> {
        self.inside.iter().enumerate().filter(|(_, inside)| **inside).map(|(index, _)| index)
    }

    /// Returns the voxels that do not belong to the set.
    pub fn complement(&self) -> Mask {
        Mask { inside: self.inside.iter().map(|inside| !inside).collect(), ..*self }
    }

    /// Returns the set with a border of one outside voxel, in which each voxel has all its neighbours.
    pub(super) fn framed(&self) -> Framed {
        let size = self.size.map(|n| n + 2);
        let mut framed = Framed { size, inside: vec![false; size.iter().product()] };
        for index in self.voxels() {
            let at = framed.index_of(self, index);
            framed.inside[at] = true;
        }
        framed
    }
}

/// A set of voxels with a border of one outside voxel.
pub(super) struct Framed {
    size: [usize; 3],
    pub(super) inside: Vec<bool>,
}

/// Neighbours of a voxel and the voxel itself: 3 x 3 x 3 cells.
pub(super) const CELLS: usize = 27;

/// Cell of the voxel itself.
pub(super) const CENTRE: usize = 13;

/// Steps from a voxel along the axes to a cell of its neighbourhood, -1 to 1 each.
pub(super) const fn steps_to(cell: usize) -> [isize; 3] {
    [(cell % 3) as isize - 1, (cell / 3 % 3) as isize - 1, (cell / 9) as isize - 1]
}

impl Framed {
    /// Index of a voxel of the unframed mask.
    pub(super) fn index_of(&self, mask: &Mask, index: usize) -> usize {
        let [nx, ny, _] = mask.size;
        let (x, y, z) = (index % nx, index / nx % ny, index / (nx * ny));
        ((z + 1) * self.size[1] + y + 1) * self.size[0] + x + 1
    }

    /// Distances in memory from a voxel to the cells of its neighbourhood.
    pub(super) fn offsets(&self) -> [isize; CELLS] {
        let [nx, ny] = [self.size[0] as isize, self.size[1] as isize];
        std::array::from_fn(|cell| {
            let [x, y, z] = steps_to(cell);
            (z * ny + y) * nx + x
        })
    }
}

/// Number of voxels in each connected component of a set, largest first. Voxels that touch, even at a corner, are connected
/// (26 neighbours).
pub fn component_sizes(mask: &Mask) -> Vec<usize> {
    let mut left = mask.framed();
    let offsets = left.offsets();
    let mut sizes = Vec::new();
    let mut waiting = Vec::new();
    for index in mask.voxels() {
        let seed = left.index_of(mask, index);
        if !std::mem::take(&mut left.inside[seed]) {
            continue;
        }
        waiting.push(seed);
        let mut size = 0;
        while let Some(voxel) = waiting.pop() {
            size += 1;
            for neighbour in offsets.map(|offset| voxel.wrapping_add_signed(offset)) {
                if std::mem::take(&mut left.inside[neighbour]) {
                    waiting.push(neighbour);
                }
            }
        }
        sizes.push(size);
    }
    sizes.sort_unstable_by(|a, b| b.cmp(a));
    sizes
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Marks the voxels of a grid where `inside` holds for the position in mm from the first voxel.
    pub(crate) fn drawn(size: [usize; 3], spacing_mm: DVec3, inside: impl Fn(DVec3) -> bool) -> Mask {
        let [nx, ny, nz] = size;
        let at = |i: usize| DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / (nx * ny)) as f64) * spacing_mm;
        Mask { size, spacing_mm, inside: (0..nx * ny * nz).map(|i| inside(at(i))).collect() }
    }

    #[test]
    fn what_touches_at_a_corner_is_connected() {
        let corner = |p: DVec3| p == DVec3::ZERO || p == DVec3::ONE;
        assert_eq!(component_sizes(&drawn([2; 3], DVec3::ONE, corner)), [2]);
        // Opposite ends of rows and planes do not touch, although they are adjacent in memory.
        let ends = |p: DVec3| p == DVec3::new(2.0, 0.0, 0.0) || p == DVec3::new(0.0, 1.0, 0.0);
        assert_eq!(component_sizes(&drawn([3; 3], DVec3::ONE, ends)), [1, 1]);
        assert!(component_sizes(&drawn([3; 3], DVec3::ONE, |_| false)).is_empty());
    }

    #[test]
    fn a_torus_is_one_component_and_two_balls_are_two() {
        let torus = |p: DVec3| {
            let p = p - 15.0;
            (p.truncate().length() - 10.0).hypot(p.z) < 3.0
        };
        let torus = drawn([31; 3], DVec3::ONE, torus);
        assert_eq!(component_sizes(&torus), [torus.voxels().count()]);
        let centres = [(DVec3::splat(6.0), 4.0), (DVec3::splat(20.0), 5.0)];
        let balls = drawn([31; 3], DVec3::ONE, |p| centres.iter().any(|(c, radius)| p.distance(*c) < *radius));
        let sizes = component_sizes(&balls);
        assert!(sizes.len() == 2 && sizes[0] > sizes[1], "{sizes:?}");
        assert_eq!(sizes.iter().sum::<usize>(), balls.voxels().count());
    }
}
