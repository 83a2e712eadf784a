//! Acyclic graph of a centreline's voxels.

use crate::trees::sampled::SampledField;
use crate::trees::tree::length_mm;
use crate::vessels::mask::Mask;
use glam::DVec3;
use std::cmp::Reverse;

/// A point of a centreline.
#[derive(Debug, Clone, PartialEq)]
pub(in crate::trees) struct Node {
    pub(in crate::trees) place_mm: DVec3,
    /// Distance to the outside of the vessel, mm.
    pub(in crate::trees) inside_mm: f64,
    /// Nodes linked to it.
    pub(in crate::trees) links: Vec<usize>,
}

/// Centrelines as points and links, without cycles.
#[derive(Debug, Clone, Default, PartialEq)]
pub(in crate::trees) struct Forest {
    pub(in crate::trees) nodes: Vec<Node>,
}

/// Disjoint sets that can be joined (union-find).
pub(in crate::trees) struct Sets(Vec<usize>);

impl Sets {
    fn apart(n: usize) -> Sets {
        Sets((0..n).collect())
    }

    /// Returns the representative of an element's set.
    fn of(&mut self, element: usize) -> usize {
        let mut at = element;
        while self.0[at] != at {
            self.0[at] = self.0[self.0[at]];
            at = self.0[at];
        }
        at
    }

    /// Returns the representative of each element's set.
    pub(in crate::trees) fn all(&mut self) -> Vec<usize> {
        (0..self.0.len()).map(|element| self.of(element)).collect()
    }

    /// Joins the sets of two elements, and tells whether they were disjoint.
    pub(in crate::trees) fn join(&mut self, a: usize, b: usize) -> bool {
        let (a, b) = (self.of(a), self.of(b));
        self.0[a] = b;
        a != b
    }
}

/// Tells whether a node lies within a branch, that is, is neither an end nor a bifurcation.
fn is_within(node: &Node) -> bool {
    node.links.len() == 2
}

impl Forest {
    /// Links the touching voxels of a centreline. The weakest link of each cycle is left out: the one with the minimum
    /// attenuation at the weaker of its ends. `inside_mm` gives a voxel's distance to the outside of the vessel.
    pub(in crate::trees) fn of(line: &Mask, field: &SampledField, inside_mm: impl Fn(usize) -> f64) -> Forest {
        let voxels: Vec<usize> = line.voxels().collect();
        let [nx, ny, nz] = line.size;
        let at = |voxel: usize| [voxel % nx, voxel / nx % ny, voxel / (nx * ny)];
        let mut links = Vec::new();
        for (a, voxel) in voxels.iter().enumerate() {
            let [x, y, z] = at(*voxel);
            let around = |i: usize, n: usize| i.saturating_sub(1)..(i + 2).min(n);
            for (z, y) in around(z, nz).flat_map(|z| around(y, ny).map(move |y| (z, y))) {
                for other in around(x, nx).map(|x| (z * ny + y) * nx + x).filter(|other| other > voxel) {
                    if let Ok(b) = voxels.binary_search(&other) {
                        links.push((a, b));
                    }
                }
            }
        }
        // Non-negative values are ordered like their bit patterns.
        let strength = |(a, b): &(usize, usize)| field.values[voxels[*a]].min(field.values[voxels[*b]]).to_bits();
        links.sort_by_key(|link| Reverse(strength(link)));
        let node =
            |voxel: &usize| Node { place_mm: field.place_mm(*voxel), inside_mm: inside_mm(*voxel), links: Vec::new() };
        let mut forest = Forest { nodes: voxels.iter().map(node).collect() };
        let mut sets = Sets::apart(voxels.len());
        for (a, b) in links {
            if sets.join(a, b) {
                forest.link(a, b);
            }
        }
        forest
    }

    pub(in crate::trees) fn link(&mut self, a: usize, b: usize) {
        self.nodes[a].links.push(b);
        self.nodes[b].links.push(a);
    }

    /// Removes the links of nodes; nodes without links do not belong to the forest.
    pub(in crate::trees) fn unlink(&mut self, nodes: &[usize]) {
        for node in nodes {
            for other in std::mem::take(&mut self.nodes[*node].links) {
                self.nodes[other].links.retain(|back| back != node);
            }
        }
    }

    /// Nodes from a node along a link, up to the next end or bifurcation.
    pub(in crate::trees) fn chain(&self, from: usize, link: usize) -> Vec<usize> {
        let mut chain = vec![from, link];
        let (mut before, mut at) = (from, link);
        while is_within(&self.nodes[at]) {
            let links = &self.nodes[at].links;
            let next = if links[0] == before { links[1] } else { links[0] };
            chain.push(next);
            (before, at) = (at, next);
        }
        chain
    }

    /// Nodes at the ends of lines.
    pub(in crate::trees) fn ends(&self) -> impl Iterator<Item = usize> {
        (0..self.nodes.len()).filter(|node| self.is_end(*node))
    }

    /// Tells whether a node is an end.
    pub(in crate::trees) fn is_end(&self, node: usize) -> bool {
        self.nodes[node].links.len() == 1
    }

    /// Positions of nodes, mm.
    pub(in crate::trees) fn places_mm(&self, nodes: &[usize]) -> Vec<DVec3> {
        nodes.iter().map(|node| self.nodes[*node].place_mm).collect()
    }

    /// Length of a chain of nodes, mm.
    pub(in crate::trees) fn length_mm(&self, chain: &[usize]) -> f64 {
        length_mm(&self.places_mm(chain))
    }

    /// Returns the trees as disjoint sets of nodes.
    pub(in crate::trees) fn trees(&self) -> Sets {
        let mut sets = Sets::apart(self.nodes.len());
        for (a, node) in self.nodes.iter().enumerate() {
            node.links.iter().for_each(|b| _ = sets.join(a, *b));
        }
        sets
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::grid::PatientGrid;

    /// A ring of voxels in a plane; attenuation is 1 except for the values in `weak`.
    fn ring(weak: &[([usize; 2], f32)]) -> (Mask, SampledField) {
        const N: usize = 7;
        let mut inside = vec![false; N * N];
        for i in 1..6 {
            for [x, y] in [[i, 1], [i, 5], [1, i], [5, i]] {
                inside[y * N + x] = true;
            }
        }
        let mut values = vec![1.0; N * N];
        weak.iter().for_each(|([x, y], value)| values[y * N + x] = *value);
        let size = [N, N, 1];
        let grid = PatientGrid { origin_mm: DVec3::ZERO, spacing_mm: DVec3::ONE, size: size.map(|n| n as u32) };
        (Mask { size, spacing_mm: DVec3::ONE, inside }, SampledField { grid, values })
    }

    #[test]
    fn a_ring_is_cut_where_it_is_weakest() {
        for weakest in [[1, 3], [4, 5], [5, 2]] {
            let (mask, field) = ring(&[([3, 1], 0.7), (weakest, 0.3)]);
            let forest = Forest::of(&mask, &field, |_| 0.0);
            let ends: Vec<usize> = forest.ends().collect();
            let place = DVec3::new(weakest[0] as f64, weakest[1] as f64, 0.0);
            assert!(ends.iter().any(|end| forest.nodes[*end].place_mm == place), "an end at {weakest:?}: {forest:?}");
            let links: usize = forest.nodes.iter().map(|node| node.links.len()).sum();
            assert_eq!(links, 2 * (forest.nodes.len() - 1), "one tree of all voxels");
            assert!(forest.trees().all().windows(2).all(|pair| pair[0] == pair[1]));
        }
    }

    #[test]
    fn chains_end_at_ends_and_bifurcations() {
        let node = |x: f64| Node { place_mm: DVec3::X * x, inside_mm: 1.0, links: Vec::new() };
        let mut forest = Forest { nodes: (0..6).map(|i| node(f64::from(i))).collect() };
        [(0, 1), (1, 2), (2, 3), (2, 4), (4, 5)].into_iter().for_each(|(a, b)| forest.link(a, b));
        assert_eq!(forest.chain(0, 1), [0, 1, 2]);
        assert_eq!(forest.chain(2, 4), [2, 4, 5]);
        assert_eq!(forest.length_mm(&[2, 4, 5]), 3.0);
        assert_eq!(forest.ends().collect::<Vec<_>>(), [0, 3, 5]);
        // Without one of its lines, the bifurcation becomes an inner point of the other.
        forest.unlink(&[3]);
        assert_eq!(forest.chain(0, 1), [0, 1, 2, 4, 5]);
    }
}
