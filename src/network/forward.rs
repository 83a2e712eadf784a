//! The forward pass of a batch, shared by training and rendering: live samples, network, integrals.

use crate::error::{Error, Result};
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::constants::OCCUPANCY_EPOCHS;
use crate::kernels::dispatch::{Binding, buffer_set, dispatch};
use crate::kernels::layout::{DeviceState, DispatchSize, IndirectArguments, LiveSamples, Ray, RayOut, Setup};
use crate::kernels::push;
use crate::kernels::stages::Kernels;
use crate::kernels::tuning::Tuning;
use crate::model::hull::Hull;
use crate::model::params::ParamMap;
use crate::network::Network;
use crate::network::chunk::{Chunk, chunks};
use crate::network::pass::Pass;
use std::mem::offset_of;

buffer_set! {
    /// Buffers of the forward pass, except those of the network.
    pub struct ForwardBuffers {
        /// [`Setup`].
        setup,
        /// [`DeviceState`].
        state,
        /// [`crate::kernels::layout::Schedule`] of each iteration.
        schedule,
        /// Cells of the motion hull, one bit each.
        hull,
        /// Parameters, at the positions in [`ParamMap`].
        params,
        /// Another binding of the buffer `params`: parameters of the static field come first.
        static_params,
        /// [`Ray`]s of the batch.
        rays,
        /// [`RayOut`] of each ray.
        ray_out,
        /// Live depths of each lane, one bit each.
        lane_masks,
        /// Number of live samples of a ray's lanes before each lane.
        lane_offsets,
        /// Number of live samples of each ray.
        ray_counts,
        /// Number of live samples of the rays before each ray.
        ray_start,
        /// [`LiveSamples`].
        live,
        /// [`IndirectArguments`].
        arguments,
        /// Position and path length of each live sample.
        sample_points,
        /// Ray of each live sample, and whether the sample is near.
        sample_rays,
        /// Attenuation of each live sample, and its derivative.
        sample_sigma,
        /// Cells in which the dynamic field was found empty.
        occupancy,
    }
}

/// Buffers of the pose that a rendering is of.
pub struct PoseBuffers {
    /// One [`crate::kernels::layout::View`].
    pub views: Buffer,
    /// A [`crate::kernels::layout::Pose`].
    pub pose: Buffer,
}

impl ForwardBuffers {
    /// Allocates the buffers for batches of `n_rays`; parameters are left undefined.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`] naming the buffer.
    pub fn new(
        gpu: &Gpu,
        tuning: &Tuning,
        setup: &Setup,
        params: &ParamMap,
        n_rays: u32,
        schedule: Buffer,
        hull: Option<&Hull>,
    ) -> Result<ForwardBuffers> {
        // Samplers of volumes may have fewer samples per ray and more rays per chunk than `setup` says.
        let n_rays = u64::from(n_rays);
        let lanes = n_rays * u64::from(tuning.ray_lanes);
        let capacity = u64::from(setup.sample_capacity);
        let lane_words = u64::from(setup.n_dynamic_samples.div_ceil(tuning.ray_lanes).div_ceil(u32::BITS));
        let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
        let params = gpu.operand_buffer("params", params.len as u64 * 4, tuning.operands)?;
        Ok(ForwardBuffers {
            setup: gpu.buffer_with("setup", &[*setup])?,
            state: new(Binding::state, size_of::<DeviceState>() as u64)?,
            schedule,
            // Without a hull, the buffer is a single empty word.
            hull: gpu.buffer_with("hull", hull.map_or(&[0][..], |h| &h.bits))?,
            static_params: params.clone(),
            params,
            rays: new(Binding::rays, n_rays * size_of::<Ray>() as u64)?,
            ray_out: new(Binding::ray_out, n_rays * size_of::<RayOut>() as u64)?,
            // The masks have one bit per sample of each ray, live or not; each lane's bits are rounded up to words.
            lane_masks: new(Binding::lane_masks, lanes * lane_words * 4)?,
            lane_offsets: new(Binding::lane_offsets, lanes * 4)?,
            ray_counts: new(Binding::ray_counts, n_rays * 4)?,
            ray_start: new(Binding::ray_start, (n_rays + 1) * 4)?,
            live: new(Binding::live, size_of::<LiveSamples>() as u64)?,
            arguments: new(Binding::arguments, size_of::<IndirectArguments>() as u64)?,
            sample_points: new(Binding::sample_points, capacity * 16)?,
            sample_rays: new(Binding::sample_rays, capacity * 4)?,
            sample_sigma: new(Binding::sample_sigma, capacity * 8)?,
            occupancy: new(Binding::occupancy, occupancy_bytes(setup))?,
        })
    }

    /// Records the rays of `push.n_rays` pixels of a pose.
    ///
    /// # Errors
    /// [`Error::Internal`] when stage and buffers do not fit.
    pub fn record_pose(
        &self,
        recording: &mut Recording,
        kernels: &Kernels,
        of: &PoseBuffers,
        push: push::PoseRays,
    ) -> Result<()> {
        let stage = &kernels.pose_rays;
        let bound = [
            (Binding::views, (&of.views).into()),
            (Binding::pose, (&of.pose).into()),
            (Binding::rays, (&self.rays).into()),
        ];
        dispatch(recording, stage, stage.groups_for(push.n_rays), &bound, push)
    }

    /// Returns one invocation per padded sample.
    pub fn per_sample(&self) -> Groups<'_> {
        self.indirect(offset_of!(IndirectArguments, samples))
    }

    /// Returns one workgroup per tile of samples and of a layer's neurons.
    pub fn forward_tiles(&self) -> Groups<'_> {
        self.indirect(offset_of!(IndirectArguments, forward_tiles))
    }

    /// Returns one workgroup per tile of samples and of a layer's inputs.
    pub fn backward_tiles(&self) -> Groups<'_> {
        self.indirect(offset_of!(IndirectArguments, backward_tiles))
    }

    fn indirect(&self, offset: usize) -> Groups<'_> {
        // The device reads three words.
        const { assert!(size_of::<DispatchSize>() == 12) };
        Groups::Indirect(&self.arguments, offset as u64)
    }
}

impl ForwardBuffers {
    /// Records that no ray has live samples, for passes without a network, which count none.
    pub fn clear_samples(&self, recording: &mut Recording) {
        for buffer in [&self.ray_counts, &self.ray_start, &self.lane_masks, &self.lane_offsets, &self.live] {
            recording.fill(buffer, 0);
        }
    }
}

/// Number of bytes of all epochs of occupancy; 0 when occupancy is off.
pub fn occupancy_bytes(setup: &Setup) -> u64 {
    if setup.occupancy_cells > 0 { u64::from(OCCUPANCY_EPOCHS) * 4 * setup.occupancy_words() as u64 } else { 0 }
}

impl Pass<'_> {
    /// Records the live dynamic samples of a chunk: counts, then offsets, indirect arguments and positions. Without a network
    /// there are none, and nothing is recorded.
    ///
    /// # Errors
    /// Fails like [`Pass::run`].
    pub fn samples(&mut self, chunk: Chunk) -> Result<()> {
        let Some(network) = self.network else { return Ok(()) };
        self.count(chunk)?;
        self.place(network, chunk)
    }

    /// Records which samples of a chunk's rays are live, and their number per ray.
    ///
    /// # Errors
    /// Fails like [`Pass::run`].
    pub fn count(&mut self, chunk: Chunk) -> Result<()> {
        let Chunk { first_ray, n_rays } = chunk;
        self.run(
            &self.kernels.march_count,
            chunk.workgroups(self.kernels.rays_counted),
            push::MarchCount { first_ray, n_rays },
        )
    }

    /// Records offsets, indirect arguments and positions of a chunk whose samples were counted.
    fn place(&mut self, network: &Network, chunk: Chunk) -> Result<()> {
        let k = self.kernels;
        let Chunk { first_ray, n_rays } = chunk;
        self.run(&k.march_scan, Groups::Direct([1, 1, 1]), network.scan(chunk))?;
        self.run(&k.march_emit, chunk.workgroups(k.rays_counted), push::MarchEmit { first_ray, n_rays })
    }

    /// Records the dynamic field at the live samples of `n_rays` rays that are already in `rays`, written to the rows of
    /// `volume`.
    ///
    /// # Errors
    /// Fails like [`Pass::run`].
    pub fn volume(&mut self, n_rays: u32, volume: &Buffer) -> Result<()> {
        let Some(network) = self.network else { return Ok(()) };
        let (k, buffers) = (self.kernels, self.buffers);
        network.record_weights(self)?;
        for chunk in chunks(self.setup, n_rays) {
            self.samples(chunk)?;
            network.record_forward(self)?;
            let bound = [(Binding::volume, volume.into())];
            self.run_with(&k.volume_dynamic, buffers.per_sample(), &bound, push::VolumeDynamic {})?;
        }
        Ok(())
    }

    /// Records the stages that depend on parameters alone, for each network.
    ///
    /// # Errors
    /// Fails like [`Pass::run`].
    pub fn weights(&mut self) -> Result<()> {
        self.network.map_or(Ok(()), |network| network.record_weights(self))?;
        self.static_network.map_or(Ok(()), |static_network| static_network.record_weights(self))
    }

    /// Records the networks at the live samples.
    ///
    /// # Errors
    /// Fails like [`Pass::run`].
    pub fn fields(&mut self) -> Result<()> {
        self.network.map_or(Ok(()), |network| network.record_forward(self))?;
        self.static_network.map_or(Ok(()), |static_network| static_network.record_forward(self))
    }

    /// Records a rendering of `n_rays` rays that are already in `rays`: integrals and, on demand, maxima are written to
    /// `ray_out`.
    ///
    /// # Errors
    /// [`Error::Internal`] for jittered depths; otherwise fails like [`Pass::run`].
    pub fn render(&mut self, n_rays: u32, maxima: bool) -> Result<()> {
        if self.setup.jitter != 0 {
            return Err(Error::Internal("rendering needs regular depths".into()));
        }
        self.weights()?;
        for chunk in chunks(self.setup, n_rays) {
            if self.network.is_some() {
                self.count(chunk)?;
            }
            self.render_chunk(chunk, maxima)?;
        }
        Ok(())
    }

    /// Records a rendering like [`Pass::render`], for rays whose samples were counted, in chunks that have room for them.
    ///
    /// # Errors
    /// Fails like [`Pass::run`].
    pub fn render_counted(&mut self, chunks: &[Chunk], maxima: bool) -> Result<()> {
        self.weights()?;
        chunks.iter().try_for_each(|chunk| self.render_chunk(*chunk, maxima))
    }

    fn render_chunk(&mut self, chunk: Chunk, maxima: bool) -> Result<()> {
        if let Some(network) = self.network {
            self.place(network, chunk)?;
        }
        self.fields()?;
        let Chunk { first_ray, n_rays } = chunk;
        match self.static_network {
            None => {
                let push = push::MarchFwd { first_ray, n_rays, with_maxima: u32::from(maxima) };
                self.run(&self.kernels.march_fwd, chunk.workgroups(self.kernels.rays_marched), push)
            }
            Some(static_network) => static_network.record_integrals(self, chunk, maxima),
        }
    }
}
