//! Projections of a reconstruction for any pose and phase, through the kernels that train it.

use crate::error::{Error, Result};
use crate::geometry::ViewRays;
use crate::gpu::device::Gpu;
use crate::gpu::memory::{Buffer, Memory};
use crate::gpu::record::{Commands, Recording};
use crate::kernels::dispatch::{Buffers, dispatch, groups_for};
use crate::kernels::layout::{DeviceState, RayOut, Schedule, Setup, View};
use crate::kernels::stages::Kernels;
use crate::kernels::tuning::Tuning;
use crate::model::Model;
use crate::model::component::Component;
use crate::model::params::ParamLayout;
use crate::model::setup::sample_capacity;
use crate::network::Network;
use crate::network::forward::{forward_buffers, hull_buffer, record_render, record_volume};
use crate::render::quantity::{Projection, Quantity};

/// Pixels rendered by one submit.
pub(super) const RAYS_PER_SUBMIT: u32 = 1 << 16;

/// What every pixel of a view sees; all lists are rows first, attenuation per world unit.
#[derive(Debug, Clone, Default)]
pub struct Rendering {
    /// Line integral of the static field.
    pub static_integral: Vec<f32>,
    /// Line integral of the dynamic field.
    pub dynamic_integral: Vec<f32>,
    /// Largest attenuation of the static field along the ray.
    pub static_max: Vec<f32>,
    /// Largest attenuation of the dynamic field along the ray.
    pub dynamic_max: Vec<f32>,
    /// Largest sum of both along the ray.
    pub total_max: Vec<f32>,
}

impl Rendering {
    fn extend(&mut self, seen: &[RayOut]) {
        for r in seen {
            self.static_integral.push(r.static_integral);
            self.dynamic_integral.push(r.dynamic_integral);
            self.static_max.push(r.static_max);
            self.dynamic_max.push(r.dynamic_max);
            self.total_max.push(r.total_max);
        }
    }

    /// What a view shows; maxima per world unit.
    pub fn show(self, quantity: Quantity) -> Vec<f32> {
        match (quantity.projection, quantity.component) {
            (Projection::Drr, Component::Total) => self.total_integral(),
            (Projection::Drr, Component::Static) => self.static_integral,
            (Projection::Drr, Component::Dynamic) => self.dynamic_integral,
            (Projection::Mip, Component::Total) => self.total_max,
            (Projection::Mip, Component::Static) => self.static_max,
            (Projection::Mip, Component::Dynamic) => self.dynamic_max,
        }
    }

    /// Sum of both integrals.
    pub fn total_integral(&self) -> Vec<f32> {
        self.static_integral.iter().zip(&self.dynamic_integral).map(|(s, d)| s + d).collect()
    }
}

/// Renders a model on a device.
pub struct Renderer {
    pub(super) gpu: Gpu,
    pub(super) kernels: Kernels,
    network: Network,
    pub(super) buffers: Buffers,
    pub(super) setup: Setup,
    model_layout: ParamLayout,
}

impl Renderer {
    /// Loads a model.
    ///
    /// # Errors
    /// Device errors.
    pub fn new(gpu: &Gpu, model: &Model, tuning: Tuning) -> Result<Renderer> {
        let network = Network::new(gpu, &tuning, &model.layout, false)?;
        let kernels = Kernels::new(gpu, tuning, model.layout.line_len() as u32)?;
        let mut setup = model.scene.setup(&model.config, &model.layout, model.hull.as_ref());
        setup.jitter = 0;
        setup.occupancy_cells = 0;
        setup.n_static_samples = model.config.march.render_samples;
        setup.n_dynamic_samples = model.config.march.render_samples;
        let largest = kernels.tuning.chunk_samples.min(network.largest_chunk(gpu, &model.layout));
        setup.sample_capacity = setup.sample_capacity.min(sample_capacity(largest));
        let mut buffers = forward_buffers(gpu, &kernels.tuning, &network, &setup, &model.layout, RAYS_PER_SUBMIT)?;
        buffers.set("hull", hull_buffer(gpu, model.hull.as_ref())?);
        // The schedule below has a single row, that of the model's step.
        gpu.upload(buffers.get("state")?, 0, &[DeviceState::default()])?;
        let row = size_of::<Schedule>() as u64;
        buffers.set("schedule", gpu.buffer("schedule", row, Memory::Upload)?);
        let renderer =
            Renderer { gpu: gpu.clone(), kernels, network, buffers, setup, model_layout: model.layout.clone() };
        renderer.set_model(model)?;
        Ok(renderer)
    }

    /// Replaces parameters and window by those of `model`, which must have the same layout.
    ///
    /// # Errors
    /// [`Error::Internal`] for another layout; device errors.
    pub fn set_model(&self, model: &Model) -> Result<()> {
        if model.layout != self.model_layout {
            return Err(Error::Internal("the model has another layout than the renderer".into()));
        }
        self.gpu.upload(self.buffers.get("params")?, 0, &model.params)?;
        self.buffers.get("schedule")?.write(&[model.config.schedule(model.step)])
    }

    /// Takes the parameters in `params`, of a run in training, as they are after everything submitted so far; returns
    /// at once. `schedule` is that of the run's present iteration. Keep the result until what is rendered next is done:
    /// dropping it waits. No rendering may be under way.
    ///
    /// # Errors
    /// [`Error::Internal`] when the buffer has another size; device errors.
    pub fn follow(&self, params: &Buffer, schedule: Schedule) -> Result<Commands> {
        let mut recording = Recording::new(&self.gpu, "follow")?;
        recording.copy(params, 0, self.buffers.get("params")?, 0, self.model_layout.len as u64 * 4)?;
        self.buffers.get("schedule")?.write(&[schedule])?;
        let commands = recording.finish()?;
        commands.submit()?;
        Ok(commands)
    }

    /// Refuses a phase the model does not have.
    ///
    /// # Errors
    /// [`Error::Config`] naming the phase.
    pub fn check_phase(&self, phase: u32) -> Result<()> {
        if phase < self.setup.n_phases {
            return Ok(());
        }
        Err(Error::config("phase", phase, format!("phases go from 0 to {}", self.setup.n_phases - 1)))
    }

    /// Most samples a ray may have.
    pub(super) fn largest_row(&self) -> u32 {
        self.setup.sample_capacity / 128 * 128
    }

    /// Records the dynamic field at the samples of `n_rays` rays, put into the rows of `volume`.
    pub(super) fn record_dynamic_cells(
        &self,
        r: &mut Recording,
        buffers: &Buffers,
        setup: &Setup,
        n_rays: u32,
    ) -> Result<()> {
        record_volume(r, &self.kernels, &self.network, buffers, &self.model_layout, setup, n_rays)
    }

    /// Renders a `width` x `height` view at a phase.
    ///
    /// # Errors
    /// [`Error::Config`] for a phase the model does not have; device errors.
    pub fn render(&self, rays: &ViewRays, width: usize, height: usize, phase: u32) -> Result<Rendering> {
        self.check_phase(phase)?;
        let mut buffers = self.buffers.clone();
        buffers.set("views", self.gpu.buffer_with("views", &[View::of(rays)])?);
        let pixels = (width * height) as u32;
        let mut out = Rendering::default();
        for first in (0..pixels).step_by(RAYS_PER_SUBMIT as usize) {
            let n = RAYS_PER_SUBMIT.min(pixels - first);
            let mut recording = Recording::new(&self.gpu, "render")?;
            let push = [first, n, phase, width as u32, 0];
            let stage = &self.kernels.pose_rays;
            dispatch(&mut recording, stage, groups_for(stage, n), &buffers, &[], push)?;
            record_render(&mut recording, &self.kernels, &self.network, &buffers, &self.model_layout, &self.setup, n)?;
            self.gpu.wait(recording.finish()?.submit()?)?;
            let seen: Vec<RayOut> = self.gpu.download(buffers.get("ray_out")?, 0, n as usize)?;
            out.extend(&seen);
        }
        Ok(out)
    }
}
