//! A field's network within an iteration, computed on one of two paths: [`layers`] or [`fused`]. The dynamic field is a
//! network; the static field may be another one ([`static_network`]).

pub mod chunk;
pub mod cost;
pub mod forward;
pub mod fused;
pub mod layers;
pub mod pass;
pub mod static_network;

use crate::error::{Error, Result};
use crate::fitting::ledger::{Ledger, StageWork, add};
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::kernels::constants::NOWHERE;
use crate::kernels::dispatch::{Binding, BufferSet, buffer_set};
use crate::kernels::layout::Setup;
use crate::kernels::push;
use crate::kernels::tuning::{Layers, Tuning};
use crate::model::params::NetworkMap;
use crate::network::chunk::Chunk;
use crate::network::fused::FusedNetwork;
use crate::network::layers::LayerNetwork;
use crate::network::pass::Pass;

/// Initial loss scale of a run on matrices.
pub const FIRST_LOSS_SCALE: f32 = 65_536.0;
/// Initial loss scale where both fields are networks, with attenuations and gradients a hundred times as small. It is also the
/// largest scale that `report` allows.
pub const FIRST_LOSS_SCALE_OF_TWO: f32 = 16_777_216.0;

/// Bytes of a number in f32.
pub(crate) const F32_BYTES: u64 = 4;
/// Bytes of a number in f16.
const F16_BYTES: u64 = 2;
/// Bytes of a live sample's position, ray and pair of attenuations.
const SAMPLE_BYTES: u64 = 16 + 4 + 8;

/// Purpose that a network is built for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Purpose {
    /// The forward pass alone.
    Render,
    /// Forward and backward.
    Train,
}

/// One way to compute the network: its kernels and the buffers that only it needs.
trait Path: Send + Sync {
    /// Returns the buffer of that name, if it is among the path's.
    fn find(&self, name: Binding) -> Option<&Buffer>;

    /// Returns samples per tile, and tiles across a layer forward and backward.
    fn tiles(&self, params: &NetworkMap) -> Tiles;

    /// Returns how many partial sums of the gradient the backward pass leaves, and their length.
    fn partial_sums(&self, params: &NetworkMap) -> PartialSums;

    /// Returns, for each network parameter, the position of its gradient within one part of the partial sums.
    fn gradient_source(&self, params: &NetworkMap) -> Vec<u32>;

    /// Records the stages that depend on parameters alone.
    fn record_weights(&self, map: &NetworkMap, pass: &mut Pass<'_>) -> Result<()>;

    /// Records the network over the live samples, which writes `sample_sigma`.
    fn record_forward(&self, map: &NetworkMap, pass: &mut Pass<'_>) -> Result<()>;

    /// Records the backward pass of a chunk, which writes `partials`.
    fn record_backward(&self, map: &NetworkMap, pass: &mut Pass<'_>, chunk: Chunk) -> Result<()>;

    /// Minimum work of the stages that process samples, for `samples` of them.
    fn work(&self, params: &NetworkMap, samples: u64) -> Ledger;

    /// Returns the positions within a part of the sums of dz over each phase; empty where `phase_dz` has them already.
    fn phase_source(&self, _: &NetworkMap) -> Vec<u32> {
        Vec::new()
    }
}

/// Tiles that the layers are computed in.
struct Tiles {
    /// Samples of a tile.
    samples: u32,
    /// Tiles across a layer, forward.
    forward: u32,
    /// Tiles across a layer, backward to its input.
    backward: u32,
}

/// Number and length of the partial sums of the gradient, one for each part of the samples, which must still be added up.
struct PartialSums {
    /// Number of parts.
    splits: u32,
    /// Numbers of each part.
    len: u32,
}

buffer_set! {
    /// The network's gradient on its way to the optimiser.
    pub struct GradientBuffers {
        /// Sums over parts of the samples, `[part][number]`.
        partials,
        /// Position within a part of the gradient of each network parameter, then of each sum of dz over a phase.
        source,
        /// Sums of dz over each phase, `[layer][phase][neuron]`.
        phase_dz,
    }
}

/// A network: kernels and buffers.
pub struct Network {
    map: NetworkMap,
    layers: Layers,
    first_loss_scale: f32,
    path: Box<dyn Path>,
    weights: WeightBuffers,
    gradient: Option<GradientBuffers>,
}

buffer_set! {
    /// Positions of the parameters.
    struct WeightBuffers {
        /// Positions of each layer's bias and of its weights on latents; NOWHERE where it has no such weights.
        network_layers,
    }
}

/// Returns the maximum number of samples of a chunk, limited by the range of one storage buffer.
pub fn largest_chunk(gpu: &Gpu, tuning: &Tuning, params: &NetworkMap) -> u32 {
    let bytes_per_sample = match tuning.layers {
        Layers::F32 => 4 * params.width,
        Layers::Matrices => 2 * params.width * params.layers.len(),
    };
    // Capacities are padded by up to 256 samples.
    (gpu.info().max_storage_buffer_range / bytes_per_sample as u32).saturating_sub(256)
}

impl Network {
    /// Builds the kernels that `tuning` asks for, and the buffers for chunks of the size in `setup`.
    ///
    /// # Errors
    /// [`Error::Config`] when matrices are requested and do not fit; errors of the device, among them [`Error::OutOfMemory`]
    /// naming the buffer.
    pub fn new(gpu: &Gpu, tuning: &Tuning, setup: &Setup, params: &NetworkMap, purpose: Purpose) -> Result<Network> {
        let path: Box<dyn Path> = match tuning.layers {
            Layers::F32 => Box::new(LayerNetwork::new(gpu, tuning, setup, params, purpose)?),
            Layers::Matrices => Box::new(FusedNetwork::new(gpu, tuning, setup, params, purpose)?),
        };
        let rows = (params.layers.len() * params.phases * params.width) as u64;
        let layers: Vec<[u32; 2]> = params
            .layers
            .iter()
            .map(|layer| [layer.bias as u32, layer.latent.map_or(NOWHERE, |at| at as u32)])
            .collect();
        let weights = WeightBuffers { network_layers: gpu.buffer_with("network_layers", &layers)? };
        let gradient = match purpose {
            Purpose::Render => None,
            Purpose::Train => {
                let sums = path.partial_sums(params);
                let source = [path.gradient_source(params), path.phase_source(params)].concat();
                let bytes = u64::from(sums.splits) * u64::from(sums.len) * 4;
                Some(GradientBuffers {
                    partials: gpu.buffer("partials", bytes, Memory::Device)?,
                    source: gpu.buffer_with("gradient_source", &source)?,
                    phase_dz: gpu.buffer("phase_dz", rows * 4, Memory::Device)?,
                })
            }
        };
        let first_loss_scale = match tuning.layers {
            Layers::F32 => 1.0,
            Layers::Matrices if setup.two_networks != 0 => FIRST_LOSS_SCALE_OF_TWO,
            Layers::Matrices => FIRST_LOSS_SCALE,
        };
        Ok(Network { map: params.clone(), layers: tuning.layers, first_loss_scale, path, weights, gradient })
    }

    /// Returns the positions of its parameters.
    pub fn map(&self) -> &NetworkMap {
        &self.map
    }

    /// Returns the path that computes the layers.
    pub fn layers(&self) -> Layers {
        self.layers
    }

    /// Returns the initial loss scale.
    pub fn first_loss_scale(&self) -> f32 {
        self.first_loss_scale
    }

    /// Minimum work of an iteration's stages with `samples` live samples.
    pub fn work(&self, samples: u64) -> Ledger {
        let mut ledger = self.path.work(&self.map, samples);
        let sums = self.path.partial_sums(&self.map);
        // Each gradient is a sum over the parts, and is written once.
        let numbers = u64::from(sums.splits) * u64::from(sums.len) + self.map.len as u64;
        add(&mut ledger, "gradient_network", StageWork::per_item(numbers, 1, F32_BYTES));
        ledger
    }

    /// Returns the buffers in which the gradient is summed; none when built for rendering.
    pub fn gradient(&self) -> Option<&GradientBuffers> {
        self.gradient.as_ref()
    }

    fn find(&self, name: Binding) -> Option<&Buffer> {
        self.weights.find(name).or_else(|| self.path.find(name)).or_else(|| self.gradient.as_ref()?.find(name))
    }

    /// Records the stages that depend on parameters alone; needed once per iteration.
    ///
    /// # Errors
    /// Fails like [`Pass::run`], as do all functions below.
    pub fn record_weights(&self, pass: &mut Pass<'_>) -> Result<()> {
        self.path.record_weights(&self.map, pass)
    }

    /// Records the network over the live samples, which writes `sample_sigma`.
    ///
    /// # Errors
    /// Fails like [`Network::record_weights`].
    pub fn record_forward(&self, pass: &mut Pass<'_>) -> Result<()> {
        self.path.record_forward(&self.map, pass)
    }

    /// Records the backward pass of a chunk, which writes partial sums of the gradient.
    ///
    /// # Errors
    /// Fails like [`Network::record_weights`].
    pub fn record_backward(&self, pass: &mut Pass<'_>, chunk: Chunk) -> Result<()> {
        self.path.record_backward(&self.map, pass, chunk)
    }

    /// Records the sums over the parts, and the gradients that follow from the sums per phase: together the network's gradient.
    ///
    /// # Errors
    /// Fails like [`Network::record_weights`].
    pub fn record_gradient(&self, pass: &mut Pass<'_>) -> Result<()> {
        if self.gradient.is_none() {
            return Err(built_for_rendering());
        }
        let (k, params) = (pass.kernels, &self.map);
        let PartialSums { splits, len: n_partials } = self.path.partial_sums(params);
        let (first, count) = (params.first as u32, params.len as u32);
        let phase_sums = self.path.phase_source(params).len() as u32;
        let push = push::GradientNetwork { first, count, phase_sums, splits, n_partials };
        let lanes = (count + phase_sums) * k.tuning.gradient_parts();
        pass.run(&k.gradient_network, k.gradient_network.groups_over(lanes), push)?;
        let mut accumulate_latents = 0;
        for (i, layer) in params.layers.iter().enumerate() {
            let Some(latent) = layer.latent else { continue };
            let push = push::MlpLatentBwd {
                layer: i as u32,
                bias: layer.bias as u32,
                latent_weight: latent as u32,
                latents: params.latents as u32,
                accumulate_latents,
            };
            let n = params.width + params.latent * (params.width + params.phases);
            pass.run(&k.mlp_latent_bwd, k.mlp_latent_bwd.groups_for(n as u32), push)?;
            accumulate_latents = 1;
        }
        Ok(())
    }

    /// Returns the push constants of `march_scan` for a chunk.
    pub fn scan(&self, chunk: Chunk) -> push::MarchScan {
        let tiles = self.path.tiles(&self.map);
        push::MarchScan {
            first_ray: chunk.first_ray,
            n_rays: chunk.n_rays,
            tile_samples: tiles.samples,
            forward_rows: tiles.forward,
            backward_rows: tiles.backward,
            accumulate: chunk.accumulate(),
        }
    }
}

fn built_for_rendering() -> Error {
    Error::Internal("the network was created for rendering only".into())
}
