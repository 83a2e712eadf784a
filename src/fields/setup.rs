//! The constants that shaders read, computed from a model.

use crate::config::fields::FieldSettings;
use crate::config::sections::Networks;
use crate::config::{DynamicTarget, OcclusionRegion};
use crate::fitting::{FIXED_POINT_BITS, RING_LENGTH};
use crate::kernels::layout::Setup;
use crate::model::hull::Hull;
use crate::model::params::ParamMap;
use crate::model::scene::Scene;

/// Share of static total variation that planes have: the weight of the paper's planes.
const TV_PLANE: f64 = 1e-2;
/// Share of static total variation that lines have: the weight of the paper's lines.
const TV_LINE: f64 = 1e-3;
/// Attenuation up to which a sample is empty, as a share of the dynamic field's scale: a typical vessel's when the problem is
/// normalised, 0.01 per mm otherwise.
const EMPTY: f64 = 0.01;

impl Scene {
    /// Returns the constants for the shaders of a fit and of its model; those of a training set (ray counts, image size) stay 0.
    pub fn setup(&self, settings: &FieldSettings, params: &ParamMap, hull: Option<&Hull>) -> Setup {
        let mut setup = Setup {
            seed: settings.seed,
            n_rays: settings.rays,
            fixed_point_bits: FIXED_POINT_BITS,
            ring_length: RING_LENGTH,
            ..self.placed(params, hull)
        };
        choose_samples(&mut setup, settings);
        setup.n_bands = settings.network.as_ref().map_or(0, |network| network.bands);
        self.weigh_losses(&mut setup, settings);
        self.set_occupancy(&mut setup, settings);
        set_optimiser(&mut setup, settings);
        if let Some(networks) = &settings.networks {
            set_networks(&mut setup, networks);
        }
        setup
    }

    /// Returns the constants of a model's boxes, depths, scales and shapes alone.
    pub fn placed(&self, params: &ParamMap, hull: Option<&Hull>) -> Setup {
        let mut setup = Setup::default();
        self.place_fields(&mut setup);
        if let Some(hull) = hull {
            place_hull(&mut setup, hull);
        }
        shape_fields(&mut setup, params);
        setup
    }

    /// Sets boxes, depths and scales of both fields.
    fn place_fields(&self, setup: &mut Setup) {
        let corner = |at: [f64; 3]| at.map(|x| x as f32);
        (setup.static_min, setup.static_max) = (corner(self.static_min), corner(self.static_max));
        (setup.dynamic_min, setup.dynamic_max) = (corner(self.dynamic_min), corner(self.dynamic_max));
        [setup.static_near, setup.static_far] = self.static_depth.map(|d| d as f32);
        [setup.dynamic_near, setup.dynamic_far] = self.dynamic_depth.map(|d| d as f32);
        setup.encode_centre = corner(self.encode_centre);
        setup.encode_scale = self.encode_scale as f32;
        setup.static_shift = self.static_shift as f32;
        setup.static_gain = self.static_gain as f32;
        setup.dynamic_shift = self.dynamic_shift as f32;
        setup.dynamic_gain = self.dynamic_gain as f32;
    }

    /// Sets the weights of the objective.
    fn weigh_losses(&self, setup: &mut Setup, settings: &FieldSettings) {
        let [near, far] = self.static_depth;
        setup.static_weight = self.static_weight as f32;
        setup.dynamic_weight = self.dynamic_weight as f32;
        setup.robust_scale = self.robust_scale as f32;
        setup.min_slope = (settings.dynamic.min_slope * self.dynamic_gain) as f32;
        setup.temporal_target = u32::from(settings.loss.dynamic_target == DynamicTarget::Temporal);
        setup.occlusion_weight = settings.dynamic.occlusion as f32;
        setup.occlusion_depth = (near + (far - near) * settings.dynamic.occlusion_share) as f32;
        setup.occlusion_share = match settings.dynamic.occlusion_region {
            OcclusionRegion::DepthRange => 0.0,
            OcclusionRegion::LastRay => settings.dynamic.occlusion_share as f32,
        };
        let tv = settings.static_field.tensor().map_or(0.0, |tensor| tensor.tv);
        setup.tv_plane = (tv * TV_PLANE) as f32;
        setup.tv_line = (tv * TV_LINE) as f32;
    }

    /// Sets when and where the dynamic field counts as empty.
    fn set_occupancy(&self, setup: &mut Setup, settings: &FieldSettings) {
        let occupancy = &settings.occupancy;
        if occupancy.enabled {
            setup.occupancy_cells = occupancy.cells;
            setup.occupancy_start = settings.dynamic.delay + occupancy.start;
            setup.occupancy_threshold = (EMPTY * self.dynamic_gain) as f32;
        }
    }
}

fn place_hull(setup: &mut Setup, hull: &Hull) {
    setup.hull_enabled = 1;
    setup.hull_min = hull.min.as_vec3().into();
    setup.hull_size = hull.size.map(|n| n as u32);
    setup.hull_inv_cell = (1.0 / hull.cell) as f32;
    setup.hull_phase_words = if hull.n_phases > 1 { hull.words() as u32 } else { 0 };
}

/// Sets the numbers of samples of a ray and of a chunk.
fn choose_samples(setup: &mut Setup, settings: &FieldSettings) {
    let march = &settings.march;
    setup.n_static_samples = march.static_samples;
    setup.n_dynamic_samples = march.dynamic_samples;
    setup.jitter = 1;
    setup.per_ray_depths = u32::from(march.per_ray_depths);
    setup.along_axis = u32::from(settings.along_axis);
    let max = settings.train.chunk_samples.max(march.dynamic_samples).max(settings.render_samples);
    setup.sample_capacity = sample_capacity(max);
}

/// Sets the sizes of planes, lines and network.
fn shape_fields(setup: &mut Setup, params: &ParamMap) {
    setup.n_phases = params.phases as u32;
    setup.grid = params.grid as u32;
    setup.rank4 = params.rank4 as u32;
    if let Some(network) = &params.dynamic_network {
        setup.latent_width = network.latent as u32;
        setup.n_layers = network.layers.len() as u32;
        setup.mlp_width = network.width as u32;
    }
    setup.static_params = params.static_len as u32;
    setup.n_params = params.len as u32;
}

/// Sets the constants of the losses of two networks that have no schedule.
fn set_networks(setup: &mut Setup, networks: &Networks) {
    setup.two_networks = 1;
    setup.change_weight = networks.change_weight as f32;
    setup.min_change = networks.min_change as f32;
    setup.min_integral = networks.min_integral as f32;
    setup.stop_after = networks.stop_after;
    setup.stop_below = networks.stop_below as f32;
}

fn set_optimiser(setup: &mut Setup, settings: &FieldSettings) {
    setup.beta1 = settings.adam.beta1 as f32;
    setup.beta2 = settings.adam.beta2 as f32;
    setup.epsilon = settings.adam.epsilon as f32;
}

/// Returns the capacity, in samples, of a chunk for `samples`, which is also the stride between the features of a sample. Live
/// samples are padded to tiles of up to 128; the remainder avoids strides of powers of two, which would map a sample's features
/// to one cache set.
pub fn sample_capacity(samples: u32) -> u32 {
    samples.next_multiple_of(128) + 12
}
