//! Structure shared with the tree's shaders; `glsl/inc/gaussian_tree.glsl` is the other half.

use bytemuck::{Pod, Zeroable};

/// The grid of displacements, and what keeps motion plain.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub struct TreeSetup {
    /// Nodes along each axis of a cube around the isocentre.
    pub n_nodes: u32,
    /// Half its side, pixels at the isocentre.
    pub half_side: f32,
    /// Nodes per pixel.
    pub inverse_step: f32,
    /// Numbers per axis of a Gaussian's own motion.
    pub n_basis: u32,
    /// Penalty on squared differences of neighbouring nodes.
    pub smoothness: f32,
    /// Penalty on squared own motion.
    pub own_penalty: f32,
    /// Adam's rate of displacements, pixels.
    pub grid_rate: f32,
    /// Adam's rate of own motion, pixels.
    pub own_rate: f32,
}

impl TreeSetup {
    /// Nodes of the grid of a phase.
    pub fn nodes(&self) -> usize {
        (self.n_nodes as usize).pow(3)
    }
}
