//! The constants that shaders read, from a model.

use crate::config::{Config, DynamicTarget};
use crate::kernels::layout::Setup;
use crate::model::hull::Hull;
use crate::model::params::ParamLayout;
use crate::model::scene::Scene;
use glam::DVec3;

/// Iterations whose losses the device keeps for the host.
pub const RING_LENGTH: u32 = 1024;
/// Scale of the static gradient's 64-bit sums: resolves 1e-15, holds +-8192.
pub const FIXED_POINT_BITS: u32 = 50;

impl Scene {
    /// Constants for the shaders; those of a training set (ray counts, image size) stay 0.
    pub fn setup(&self, config: &Config, params: &ParamLayout, hull: Option<&Hull>) -> Setup {
        let scene = self;
        let f = |v: f64| v as f32;
        let (lo, hi, dlo, dhi) = (scene.static_min, scene.static_max, scene.dynamic_min, scene.dynamic_max);
        let [near, far] = scene.static_depth;
        let hull_min = hull.map_or(DVec3::ZERO, |h| h.min);
        let size = hull.map_or([0; 3], |h| h.size.map(|n| n as u32));
        Setup {
            seed: config.seed,
            n_rays: config.train.rays,
            n_phases: params.phases as u32,
            n_static_samples: config.march.static_samples,
            n_dynamic_samples: config.march.dynamic_samples,
            static_near: f(scene.static_depth[0]),
            static_far: f(scene.static_depth[1]),
            dynamic_near: f(scene.dynamic_depth[0]),
            dynamic_far: f(scene.dynamic_depth[1]),
            jitter: 1,
            per_ray_depths: u32::from(config.march.per_ray_depths),
            static_min_x: f(lo[0]),
            static_min_y: f(lo[1]),
            static_min_z: f(lo[2]),
            static_max_x: f(hi[0]),
            static_max_y: f(hi[1]),
            static_max_z: f(hi[2]),
            dynamic_min_x: f(dlo[0]),
            dynamic_min_y: f(dlo[1]),
            dynamic_min_z: f(dlo[2]),
            dynamic_max_x: f(dhi[0]),
            dynamic_max_y: f(dhi[1]),
            dynamic_max_z: f(dhi[2]),
            encode_centre_x: f(scene.encode_centre[0]),
            encode_centre_y: f(scene.encode_centre[1]),
            encode_centre_z: f(scene.encode_centre[2]),
            encode_scale: f(scene.encode_scale),
            n_bands: config.dynamic.bands,
            grid: params.grid as u32,
            rank4: params.rank4 as u32,
            static_shift: f(scene.static_shift),
            static_gain: f(scene.static_gain),
            dynamic_shift: f(scene.dynamic_shift),
            dynamic_gain: f(scene.dynamic_gain),
            static_weight: f(scene.static_weight),
            dynamic_weight: f(scene.dynamic_weight),
            robust_scale: f(scene.robust_scale),
            temporal_target: u32::from(config.loss.dynamic_target == DynamicTarget::Temporal),
            occlusion_weight: f(config.dynamic.occlusion),
            occlusion_depth: f(near + (far - near) * config.dynamic.occlusion_share),
            hull_enabled: u32::from(hull.is_some()),
            hull_nx: size[0],
            hull_ny: size[1],
            hull_nz: size[2],
            hull_min_x: f(hull_min.x),
            hull_min_y: f(hull_min.y),
            hull_min_z: f(hull_min.z),
            hull_inv_cell: hull.map_or(0.0, |h| f(1.0 / h.cell)),
            hull_phase_words: hull.map_or(0, |h| if h.n_phases > 1 { h.words() as u32 } else { 0 }),
            occupancy_cells: if config.occupancy.enabled { config.occupancy.cells } else { 0 },
            occupancy_start: config.dynamic.delay + config.occupancy.start,
            occupancy_threshold: f(config.occupancy.threshold * scene.dynamic_gain),
            sample_capacity: sample_capacity(
                config.train.chunk_samples.max(config.march.dynamic_samples).max(config.march.render_samples),
            ),
            latent_width: params.latent as u32,
            n_layers: params.layers.len() as u32,
            mlp_width: params.width as u32,
            static_params: params.static_len as u32,
            n_params: params.len as u32,
            fixed_point_bits: FIXED_POINT_BITS,
            tv_plane: f(config.static_field.tv * config.static_field.tv_plane),
            tv_line: f(config.static_field.tv * config.static_field.tv_line),
            beta1: f(config.adam.beta1),
            beta2: f(config.adam.beta2),
            epsilon: f(config.adam.epsilon),
            ring_length: RING_LENGTH,
            ..Setup::default()
        }
    }
}

/// Samples a chunk can hold that is to take `samples`; also the stride between the features of a sample. Live samples
/// are padded to tiles of up to 128; the remainder keeps strides off powers of two, which would map a sample's features
/// to one cache set.
pub fn sample_capacity(samples: u32) -> u32 {
    samples.next_multiple_of(128) + 12
}
