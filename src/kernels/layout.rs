//! Structures shared with the shaders. `glsl/inc/layout.glsl` is the other half; the test at the end
//! of this file parses it and compares every name, type and position.

use crate::geometry::ViewRays;
use bytemuck::{Pod, Zeroable};
use glam::DVec3;

macro_rules! shared {
    ($(#[$doc:meta])* $name:ident { $($field:ident : $ty:ty),* $(,)? }) => {
        $(#[$doc])*
        #[repr(C)]
        #[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
        #[allow(missing_docs, reason = "fields are documented in glsl/inc/layout.glsl")]
        pub struct $name { $(pub $field: $ty),* }

        #[cfg(test)]
        impl $name {
            const FIELDS: &'static [(&'static str, &'static str)] = &[$((stringify!($field), stringify!($ty))),*];
        }
    };
}

shared! {
    /// What stays fixed during a run.
    Setup {
        seed: u32, n_rays: u32, n_motion_rays: u32, n_all_rays: u32, n_motion_list: u32, n_pixels: u32,
        image_width: u32, n_phases: u32, n_static_samples: u32, n_dynamic_samples: u32,
        static_near: f32, static_far: f32, dynamic_near: f32, dynamic_far: f32, jitter: u32, per_ray_depths: u32,
        static_min_x: f32, static_min_y: f32, static_min_z: f32,
        static_max_x: f32, static_max_y: f32, static_max_z: f32,
        dynamic_min_x: f32, dynamic_min_y: f32, dynamic_min_z: f32,
        dynamic_max_x: f32, dynamic_max_y: f32, dynamic_max_z: f32,
        encode_centre_x: f32, encode_centre_y: f32, encode_centre_z: f32, encode_scale: f32,
        n_bands: u32, grid: u32, rank4: u32,
        static_shift: f32, static_gain: f32, dynamic_shift: f32, dynamic_gain: f32,
        static_weight: f32, dynamic_weight: f32, robust_scale: f32,
        temporal_target: u32,
        occlusion_weight: f32, occlusion_depth: f32,
        hull_enabled: u32, hull_nx: u32, hull_ny: u32, hull_nz: u32,
        hull_min_x: f32, hull_min_y: f32, hull_min_z: f32, hull_inv_cell: f32, hull_phase_words: u32,
        occupancy_cells: u32, occupancy_start: u32, occupancy_threshold: f32,
        sample_capacity: u32, latent_width: u32, n_layers: u32, mlp_width: u32,
        static_params: u32, n_params: u32, fixed_point_bits: u32,
        tv_plane: f32, tv_line: f32, beta1: f32, beta2: f32, epsilon: f32, ring_length: u32,
    }
}

shared! {
    /// One row per iteration.
    Schedule {
        static_lr: f32, dynamic_lr: f32, window: f32, dynamic_active: u32, reset: u32,
        bias_correction1: f32, bias_correction2: f32, spare: u32,
    }
}

shared! {
    /// One ray of a batch.
    Ray {
        anchor: [f32; 3], phase: u32, direction: [f32; 3], norm: f32,
        target: f32, temporal_low: f32, id: u32, temporal_high: f32,
    }
}

shared! {
    /// Rays of a view as affine functions of pixel column and row.
    View {
        anchor00: [f32; 4], anchor_du: [f32; 4], anchor_dv: [f32; 4],
        direction00: [f32; 4], direction_du: [f32; 4], direction_dv: [f32; 4],
    }
}

shared! {
    /// One training image.
    Frame { view: u32, phase: u32, image_offset: u32, background_offset: u32 }
}

shared! {
    /// What a ray sees.
    RayOut {
        static_integral: f32, dynamic_integral: f32, occlusion: f32,
        static_max: f32, dynamic_max: f32, total_max: f32, spare0: f32, spare1: f32,
    }
}

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

/// Iterations of an epoch of occupancy; the same in `glsl/inc/occupancy.glsl`.
pub const OCCUPANCY_EPOCH: u32 = 64;

impl Setup {
    /// Words of one epoch of occupancy: two bits per phase and cell.
    pub fn occupancy_words(&self) -> usize {
        (self.n_phases as usize * (self.occupancy_cells as usize).pow(3)).div_ceil(16)
    }
}

/// What the device counts from iteration to iteration: `state[4]` of the shaders.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct DeviceState {
    /// Iterations done.
    pub step: u32,
    /// Factor on gradients in f16; 1 on the f32 path.
    pub loss_scale: f32,
    /// 1 while the gradient of an iteration is not finite.
    pub overflowed: u32,
    /// Updates since the scale changed.
    pub good_updates: u32,
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `(name, type)` of each field of `struct NAME` in the GLSL file, in Rust's spelling.
    fn glsl_fields(name: &str) -> Vec<(String, String)> {
        let source = include_str!("../../glsl/inc/layout.glsl");
        let body = source.split(&format!("struct {name} {{")).nth(1).unwrap().split("};").next().unwrap();
        body.lines()
            .filter_map(|line| line.split("//").next().unwrap().trim().strip_suffix(';'))
            .map(|line| {
                let (ty, field) = line.split_once(' ').unwrap();
                let ty = match ty {
                    "uint" => "u32",
                    "float" => "f32",
                    "vec3" => "[f32; 3]",
                    "vec4" => "[f32; 4]",
                    other => panic!("type {other} has no Rust twin here"),
                };
                (field.trim().to_owned(), ty.to_owned())
            })
            .collect()
    }

    #[test]
    fn structures_match_the_shaders() {
        for (name, fields) in [
            ("Setup", Setup::FIELDS),
            ("Schedule", Schedule::FIELDS),
            ("Ray", Ray::FIELDS),
            ("View", View::FIELDS),
            ("Frame", Frame::FIELDS),
            ("RayOut", RayOut::FIELDS),
        ] {
            let rust: Vec<_> = fields.iter().map(|(n, t)| ((*n).to_owned(), (*t).to_owned())).collect();
            assert_eq!(glsl_fields(name), rust, "struct {name}");
        }
    }
}
