//! How numbers are scaled and where the fields live.

use super::params::ParamLayout;
use crate::config::{Config, DynamicTarget};
use crate::data::dataset::Dataset;
use crate::data::geometry::MM_PER_UNIT;
use crate::data::motion::{self, Hull, ViewMotion};
use crate::error::{Error, Result};
use crate::layout::Setup;
use glam::DVec3;
use serde::{Deserialize, Serialize};

/// Iterations whose losses the device keeps for the host.
pub const RING_LENGTH: u32 = 1024;
/// Scale of the static gradient's 64-bit sums: resolves 1e-15, holds +-8192.
pub const FIXED_POINT_BITS: u32 = 50;

/// How numbers are scaled and where fields live; kept in checkpoints.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Scene {
    /// Lower corner of the static field's box, world units.
    pub static_min: [f64; 3],
    /// Upper corner.
    pub static_max: [f64; 3],
    /// Lower corner of the dynamic field's box.
    pub dynamic_min: [f64; 3],
    /// Upper corner.
    pub dynamic_max: [f64; 3],
    /// Depth range of the static field around the isocentre plane.
    pub static_depth: [f64; 2],
    /// Depth range of the dynamic field.
    pub dynamic_depth: [f64; 2],
    /// Encoded coordinate = (x - centre) * scale.
    pub encode_centre: [f64; 3],
    /// See `encode_centre`.
    pub encode_scale: f64,
    /// sigma_l = gain * softplus(feature + shift), per world unit.
    pub static_gain: f64,
    /// See `static_gain`.
    pub static_shift: f64,
    /// sigma_s = gain * softplus(feature + shift), per world unit.
    pub dynamic_gain: f64,
    /// See `dynamic_gain`.
    pub dynamic_shift: f64,
    /// Weight of a squared residual of the static field.
    pub static_weight: f64,
    /// Weight of a squared residual of the dynamic field.
    pub dynamic_weight: f64,
    /// Residual of the dynamic field from which the loss grows linearly; 0 = never.
    pub robust_scale: f64,
}

impl Scene {
    /// Chooses scales and boxes for a dataset.
    ///
    /// # Errors
    /// [`Error::Data`] when the images cannot be normalised.
    pub fn new(config: &Config, dataset: &Dataset, motion: &[ViewMotion], hull: Option<&Hull>) -> Result<Scene> {
        let (near, far) = dataset.depth_range;
        let static_half = if config.static_field.half_extent_mm > 0.0 {
            config.static_field.half_extent_mm / MM_PER_UNIT
        } else {
            half_depth(dataset)
        };
        let half = dynamic_half(config, dataset);
        let (dynamic_min, dynamic_max) =
            hull.and_then(Hull::bounds).unwrap_or((DVec3::splat(-half), DVec3::splat(half)));
        let corner = dynamic_min.abs().max(dynamic_max.abs()).length();
        let dynamic_depth =
            if config.march.fit_dynamic_range { [near.max(-corner), far.min(corner)] } else { [near, far] };
        let (encode_centre, encode_scale) = if config.dynamic.encode_box {
            let centre = 0.5 * (dynamic_min + dynamic_max);
            (centre, std::f64::consts::PI / (0.5 * (dynamic_max - dynamic_min)).max_element())
        } else {
            (DVec3::ZERO, 1.0)
        };
        let mut scene = Scene {
            static_min: [-static_half; 3],
            static_max: [static_half; 3],
            dynamic_min: dynamic_min.to_array(),
            dynamic_max: dynamic_max.to_array(),
            static_depth: [near, far],
            dynamic_depth,
            encode_centre: encode_centre.to_array(),
            encode_scale,
            static_gain: 1.0,
            static_shift: -10.0,
            dynamic_gain: 1.0,
            dynamic_shift: -10.0,
            static_weight: 1.0,
            dynamic_weight: 1.0,
            robust_scale: 0.0,
        };
        if config.loss.normalise {
            scene.normalise(config, dataset, motion, hull, static_half)?;
        }
        Ok(scene)
    }

    /// Chooses gains, shifts and weights so that features, integrals and losses are near 1.
    fn normalise(
        &mut self,
        config: &Config,
        dataset: &Dataset,
        motion: &[ViewMotion],
        hull: Option<&Hull>,
        static_half: f64,
    ) -> Result<()> {
        let training = dataset.training();
        let count = (training.len() * dataset.n_pixels()) as f64;
        let sum: f64 = training.iter().flat_map(|f| &f.integrals).map(|v| f64::from(*v)).sum();
        let mean = sum / count;
        if !(mean.is_finite() && mean > 0.0) {
            return Err(Error::data(
                &dataset.path,
                "images",
                format!("their mean line integral is {mean}; it must be positive (is the intensity model right?)"),
            ));
        }
        // softplus(ln(e - 1)) = 1: a feature of zero is the mean attenuation.
        self.static_gain = mean / (2.0 * static_half);
        self.static_shift = (std::f64::consts::E - 1.0).ln();
        self.static_weight = 1.0 / (mean * mean);
        let moving: Vec<f32> = motion
            .iter()
            .flat_map(|m| m.range.iter().zip(&m.moving).filter(|(_, moving)| **moving).map(|(r, _)| *r))
            .collect();
        let change = f64::from(motion::percentile(&moving, 0.9));
        let change = if change > 0.0 { change } else { mean };
        // A vessel fills a few percent of the field of view.
        let vessel = 0.05 * field_of_view(dataset);
        self.dynamic_gain = change / vessel;
        let depth = hull
            .map_or((DVec3::from_array(self.dynamic_max) - DVec3::from_array(self.dynamic_min)).max_element(), |h| {
                mean_depth(h, dataset, motion)
            });
        self.dynamic_shift = first_shift(config.dynamic.normalised_shift, depth / vessel);
        (self.dynamic_weight, self.robust_scale) = match config.loss.dynamic_target {
            DynamicTarget::Temporal => (1.0 / (change * change), config.loss.robust * change),
            // Both fields share one squared residual.
            DynamicTarget::Absolute => (self.static_weight, 0.0),
        };
        Ok(())
    }

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

/// Radius around the isocentre that the views see, world units.
fn field_of_view(dataset: &Dataset) -> f64 {
    let (w, h) = (dataset.width as f64 - 0.5, dataset.height as f64 - 0.5);
    let mut radius = 0f64;
    for view in dataset.training_views() {
        for (i, j) in [(-0.5, -0.5), (w, -0.5), (-0.5, h), (w, h)] {
            radius = radius.max(dataset.views[view].rays.pixel(i, j).0.length());
        }
    }
    radius
}

/// How deep rays that meet the hull run inside it, on average: its volume over the area of the pixels that see it.
fn mean_depth(hull: &Hull, dataset: &Dataset, motion: &[ViewMotion]) -> f64 {
    let (mut sum, mut n) = (0.0, 0);
    for m in motion {
        let at = |i: f64, j: f64| dataset.views[m.view].rays.pixel(i, j).0;
        let pixel_area = (at(1.0, 0.0) - at(0.0, 0.0)).cross(at(0.0, 1.0) - at(0.0, 0.0)).length();
        for phase in 0..hull.n_phases {
            let seen = if hull.n_phases > 1 { &m.moving_at[phase] } else { &m.moving };
            let pixels = seen.iter().filter(|moving| **moving).count();
            if pixels > 0 {
                let bits = &hull.bits[phase * hull.words()..][..hull.words()];
                let cells: u32 = bits.iter().map(|w| w.count_ones()).sum();
                sum += f64::from(cells) * hull.cell.powi(3) / (pixels as f64 * pixel_area);
                n += 1;
            }
        }
    }
    if n > 0 { sum / f64::from(n) } else { 0.0 }
}

/// The shift inside the dynamic field's softplus that a run starts with. A field that is `depth_in_vessels` times as deep
/// as a vessel starts with as many times too large an integral, whose gradients can switch the whole network off: then
/// it starts nearer to zero.
fn first_shift(normalised_shift: f64, depth_in_vessels: f64) -> f64 {
    if depth_in_vessels <= DEEP {
        return normalised_shift;
    }
    let attenuation = normalised_shift.exp().ln_1p() / (depth_in_vessels / DEEP).powi(2);
    attenuation.exp_m1().ln().max(normalised_shift.min(-5.0))
}

fn half_depth(dataset: &Dataset) -> f64 {
    dataset.depth_range.0.abs().max(dataset.depth_range.1.abs())
}

/// Half side of the box the dynamic field is searched in, world units.
pub fn dynamic_half(config: &Config, dataset: &Dataset) -> f64 {
    if config.dynamic.half_extent_mm > 0.0 {
        config.dynamic.half_extent_mm / MM_PER_UNIT
    } else {
        field_of_view(dataset).min(half_depth(dataset))
    }
}
/// Depth of the dynamic field, in vessels, from which a run starts nearer to zero. Tight hulls of 3 and 4 views reach 2.4.
const DEEP: f64 = 2.5;

/// Samples a chunk can hold that is to take `samples`; also the stride between the features of a sample. Live samples
/// are padded to tiles of up to 128; the remainder keeps strides off powers of two, which would map a sample's features
/// to one cache set.
pub fn sample_capacity(samples: u32) -> u32 {
    samples.next_multiple_of(128) + 12
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deep_fields_start_nearer_to_zero() {
        assert_eq!(first_shift(-2.0, 2.4), -2.0);
        // Twice as deep as a run bears: a quarter of the attenuation.
        let softplus = |x: f64| x.exp().ln_1p();
        assert!((softplus(first_shift(-2.0, 2.0 * DEEP)) - softplus(-2.0) / 4.0).abs() < 1e-12);
        assert_eq!(first_shift(-2.0, 1e6), -5.0);
        assert_eq!(first_shift(-10.0, 1e6), -10.0, "a shift that was asked for is never raised");
    }
}
