//! The dynamic field's network within an iteration, on either of two paths: [`layers`] or [`fused`].

pub mod chunk;
pub mod cost;
pub mod forward;
pub mod fused;
pub mod layers;

use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::dispatch::{Buffers, dispatch, groups_for};
use crate::kernels::layout::Setup;
use crate::kernels::stages::{Kernels, LayerKernels};
use crate::kernels::tuning::{Layers, Tuning};
use crate::model::params::ParamLayout;
use crate::network::chunk::Chunk;
use crate::network::fused::FusedKernels;

/// Loss scale a run on matrices starts with.
pub const FIRST_LOSS_SCALE: f32 = 65_536.0;

/// The network's kernels.
pub enum Network {
    /// One f32 pass per layer.
    Layers(Box<LayerKernels>),
    /// Cooperative matrices.
    Fused(Box<FusedKernels>),
}

/// Groups of a dispatch over live samples, at a byte offset of the arguments `march_scan` wrote.
pub fn indirect(buffers: &Buffers, offset: usize) -> Result<Groups<'_>> {
    Ok(Groups::Indirect(buffers.get("arguments")?, offset as u64))
}

impl Network {
    /// Builds the kernels `tuning` asks for; `train` includes the backward passes.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] when matrices are asked for and do not fit; errors of the device.
    pub fn new(gpu: &Gpu, tuning: &Tuning, params: &ParamLayout, train: bool) -> Result<Network> {
        Ok(match tuning.layers {
            Layers::F32 => Network::Layers(Box::new(LayerKernels::new(gpu, tuning.clone(), params.line_len() as u32)?)),
            Layers::Matrices => Network::Fused(Box::new(FusedKernels::new(gpu, tuning, params, train)?)),
        })
    }

    /// Samples a chunk may have, by the range of one storage buffer.
    pub fn largest_chunk(&self, gpu: &Gpu, params: &ParamLayout) -> u32 {
        let bytes_per_sample = match self {
            Network::Layers(_) => 4 * params.width,
            Network::Fused(_) => 2 * params.width * params.layers.len(),
        };
        // Less what capacities are padded with.
        (gpu.info().max_storage_buffer_range / bytes_per_sample as u32).saturating_sub(256)
    }

    /// Loss scale to start with.
    pub fn first_loss_scale(&self) -> f32 {
        match self {
            Network::Layers(_) => 1.0,
            Network::Fused(_) => FIRST_LOSS_SCALE,
        }
    }

    /// Adds the buffers of the forward pass.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn forward_buffers(
        &self,
        gpu: &Gpu,
        tuning: &Tuning,
        setup: &Setup,
        params: &ParamLayout,
        buffers: &mut Buffers,
    ) -> Result<()> {
        match self {
            Network::Layers(_) => layers::forward_buffers(gpu, tuning, setup, params, buffers),
            Network::Fused(k) => k.forward_buffers(gpu, setup, params, buffers),
        }
    }

    /// Adds the buffers of the backward pass.
    ///
    /// # Errors
    /// As [`Network::forward_buffers`].
    pub fn backward_buffers(
        &self,
        gpu: &Gpu,
        tuning: &Tuning,
        setup: &Setup,
        params: &ParamLayout,
        rays_per_chunk: u64,
        buffers: &mut Buffers,
    ) -> Result<()> {
        match self {
            Network::Layers(_) => layers::backward_buffers(gpu, tuning, setup, params, rays_per_chunk, buffers),
            Network::Fused(k) => k.backward_buffers(gpu, setup, params, buffers),
        }
    }

    /// Records what depends on parameters alone: once per iteration.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when a stage and its buffers do not fit; so do all that follow.
    pub fn record_weights(
        &self,
        r: &mut Recording,
        k: &Kernels,
        buffers: &Buffers,
        params: &ParamLayout,
    ) -> Result<()> {
        for (i, layer) in params.layers.iter().enumerate() {
            let push = [
                i as u32,
                layer.bias as u32,
                layer.latent.unwrap_or(0) as u32,
                u32::from(layer.latent.is_some()),
                params.latents as u32,
            ];
            let n = (params.phases * params.width) as u32;
            dispatch(r, &k.mlp_latent_fwd, groups_for(&k.mlp_latent_fwd, n), buffers, &[], push)?;
        }
        match self {
            Network::Layers(_) => Ok(()),
            Network::Fused(fused) => fused.record_pack(r, buffers, params),
        }
    }

    /// Records the network over the live samples: `sample_sigma`.
    ///
    /// # Errors
    /// As [`Network::record_weights`].
    pub fn record_forward(
        &self,
        r: &mut Recording,
        buffers: &Buffers,
        params: &ParamLayout,
        setup: &Setup,
    ) -> Result<()> {
        match self {
            Network::Layers(k) => layers::record_forward(r, k, buffers, params, setup),
            Network::Fused(k) => k.record_forward(r, buffers, params),
        }
    }

    /// Records the backward pass of a chunk: partial sums of the gradient.
    ///
    /// # Errors
    /// As [`Network::record_weights`].
    pub fn record_backward(
        &self,
        r: &mut Recording,
        buffers: &Buffers,
        params: &ParamLayout,
        setup: &Setup,
        chunk: Chunk,
    ) -> Result<()> {
        match self {
            Network::Layers(k) => layers::record_backward(r, k, buffers, params, setup, chunk),
            Network::Fused(k) => k.record_backward(r, buffers, params, setup, chunk),
        }
    }

    /// Records the sums of the partial sums, and what follows from the sums per phase: the network's gradient.
    ///
    /// # Errors
    /// As [`Network::record_weights`].
    pub fn record_gradient(
        &self,
        r: &mut Recording,
        k: &Kernels,
        buffers: &Buffers,
        params: &ParamLayout,
    ) -> Result<()> {
        let network = params.network_len() as u32;
        let (splits, n_partials) = match self {
            Network::Layers(k) => (k.tuning.splits, network),
            Network::Fused(k) => (k.workgroups, k.partials_len()),
        };
        let names = [("source", "gradient_source")];
        let push = [params.static_len as u32, network, splits, n_partials];
        dispatch(r, &k.gradient_network, groups_for(&k.gradient_network, network), buffers, &names, push)?;
        if let Network::Fused(_) = self {
            let n = (params.layers.len() * params.phases * params.width) as u32;
            let names = [("source", "phase_source"), ("gradient", "phase_dz")];
            let groups = groups_for(&k.gradient_network, n);
            dispatch(r, &k.gradient_network, groups, buffers, &names, [0, n, splits, n_partials])?;
        }
        let mut accumulate_latents = 0;
        for (i, layer) in params.layers.iter().enumerate() {
            let Some(latent) = layer.latent else { continue };
            let push = [i as u32, layer.bias as u32, latent as u32, params.latents as u32, accumulate_latents];
            let n = params.width + params.latent * (params.width + params.phases);
            dispatch(r, &k.mlp_latent_bwd, groups_for(&k.mlp_latent_bwd, n as u32), buffers, &[], push)?;
            accumulate_latents = 1;
        }
        Ok(())
    }

    /// Push constants of `march_scan` for a chunk: among them samples per tile, and tiles across a layer forward and
    /// backward, for its indirect arguments.
    pub fn scan(&self, params: &ParamLayout, chunk: Chunk) -> [u32; 5] {
        let [tile, forward, backward] = match self {
            Network::Layers(k) => {
                let (tile, width) = (k.tuning.tile(), params.width as u32);
                [k.tuning.tile_samples(), width.div_ceil(tile.fwd_neurons), width.div_ceil(tile.bwd_inputs)]
            }
            Network::Fused(k) => [k.tile_samples(), 1, 1],
        };
        [chunk.n_rays, tile, forward, backward, u32::from(chunk.first_ray > 0)]
    }
}
