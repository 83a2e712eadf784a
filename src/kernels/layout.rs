//! Structures shared with the shaders: made by build.rs from `glsl/inc/layout.glsl`, `glsl/inc/gaussian_layout.glsl` and
//! what the compiler made of them.

use crate::geometry::ViewRays;
use crate::kernels::constants::CELLS_PER_WORD;
use glam::DVec3;

include!(concat!(env!("OUT_DIR"), "/layout.rs"));

impl View {
    /// Rays in f32.
    pub fn of(rays: &ViewRays) -> View {
        let pack = |v: DVec3| [v.x as f32, v.y as f32, v.z as f32, 0.0];
        View {
            anchor00: pack(rays.anchor[0]),
            anchor_du: pack(rays.anchor[1]),
            anchor_dv: pack(rays.anchor[2]),
            direction00: pack(rays.direction[0]),
            direction_du: pack(rays.direction[1]),
            direction_dv: pack(rays.direction[2]),
        }
    }
}

impl Setup {
    /// Words of one epoch of occupancy: two bits per phase and cell.
    pub fn occupancy_words(&self) -> usize {
        (self.n_phases as usize * (self.occupancy_cells as usize).pow(3)).div_ceil(CELLS_PER_WORD as usize)
    }
}

impl TreeSetup {
    /// Nodes of the grid of a phase.
    pub fn nodes(&self) -> usize {
        (self.n_nodes as usize).pow(3)
    }
}
