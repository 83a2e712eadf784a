//! The static field as a second network, evaluated at the samples of the dynamic field; attenuations add up (NeRF-CA). It runs
//! through the same stages, on its own buffers where the two differ. A ray's integrals and the gradient of the losses take both
//! fields at each sample.

use crate::error::Result;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::kernels::dispatch::{Binding, BufferSet};
use crate::kernels::layout::Setup;
use crate::kernels::push;
use crate::kernels::stages::StaticNetworkKernels;
use crate::kernels::tuning::Tuning;
use crate::model::params::NetworkMap;
use crate::network::chunk::Chunk;
use crate::network::forward::ForwardBuffers;
use crate::network::pass::Pass;
use crate::network::{Network, Purpose, built_for_rendering};

/// Network of the static field: kernels and buffers.
pub struct StaticNetwork {
    kernels: StaticNetworkKernels,
    network: Network,
    /// Forward buffers shared with the dynamic field; setup and attenuations are its own.
    buffers: ForwardBuffers,
    training: Option<StaticTraining>,
}

/// Buffers that only the backward pass needs.
struct StaticTraining {
    /// Gradient of each sample's attenuation.
    gradient: Buffer,
}

/// Buffers of this network's backward pass: its own gradient at samples comes first.
struct BackwardBuffers<'a> {
    gradient: &'a Buffer,
    rest: Option<&'a dyn BufferSet>,
}

impl BufferSet for BackwardBuffers<'_> {
    fn find(&self, name: Binding) -> Option<&Buffer> {
        match name {
            Binding::sigma_gradient => Some(self.gradient),
            _ => self.rest?.find(name),
        }
    }
}

/// Returns the constants with which the stages of a network compute the static field.
pub fn static_setup(setup: &Setup) -> Setup {
    Setup { dynamic_gain: setup.static_gain, dynamic_shift: setup.static_shift, ..*setup }
}

impl StaticNetwork {
    /// Builds kernels and buffers; `dynamic` are the buffers of the dynamic field.
    ///
    /// # Errors
    /// Fails like [`Network::new`].
    pub fn new(
        gpu: &Gpu,
        tuning: &Tuning,
        setup: &Setup,
        params: &NetworkMap,
        dynamic: &ForwardBuffers,
        purpose: Purpose,
    ) -> Result<StaticNetwork> {
        let capacity = u64::from(setup.sample_capacity);
        let new = |name: &str, bytes: u64| gpu.buffer(name, bytes, Memory::Device);
        let buffers = ForwardBuffers {
            setup: gpu.buffer_with("static_setup", &[static_setup(setup)])?,
            sample_sigma: new("static_sigma", capacity * 8)?,
            ..dynamic.clone()
        };
        let training = match purpose {
            Purpose::Render => None,
            Purpose::Train => Some(StaticTraining { gradient: new("static_network_gradient", capacity * 4)? }),
        };
        Ok(StaticNetwork {
            kernels: StaticNetworkKernels::new(gpu)?,
            network: Network::new(gpu, tuning, setup, params, purpose)?,
            buffers,
            training,
        })
    }

    /// The network.
    pub fn network(&self) -> &Network {
        &self.network
    }

    /// Attenuation of each live sample and its derivative.
    pub fn sigma(&self) -> &Buffer {
        &self.buffers.sample_sigma
    }

    /// Gradient of each live sample's attenuation; none when built for rendering.
    pub fn sigma_gradient(&self) -> Option<&Buffer> {
        self.training.as_ref().map(|training| &training.gradient)
    }

    /// Records `stages` for this network, with the buffers of `pass` except its own.
    fn with(&self, pass: &mut Pass<'_>, stages: impl FnOnce(&Network, &mut Pass<'_>) -> Result<()>) -> Result<()> {
        let own = self
            .training
            .as_ref()
            .map(|training| BackwardBuffers { gradient: &training.gradient, rest: pass.training });
        let mut own = Pass {
            recording: &mut *pass.recording,
            kernels: pass.kernels,
            network: Some(&self.network),
            static_network: None,
            buffers: &self.buffers,
            training: own.as_ref().map(|own| own as &dyn BufferSet),
            params: pass.params,
            setup: pass.setup,
        };
        stages(&self.network, &mut own)
    }

    /// Records the stages that depend on parameters alone.
    ///
    /// # Errors
    /// Fails like [`Pass::run`], as do all functions below.
    pub fn record_weights(&self, pass: &mut Pass<'_>) -> Result<()> {
        self.with(pass, Network::record_weights)
    }

    /// Records the network over the live samples.
    ///
    /// # Errors
    /// Fails like [`StaticNetwork::record_weights`].
    pub fn record_forward(&self, pass: &mut Pass<'_>) -> Result<()> {
        self.with(pass, Network::record_forward)
    }

    /// Records the line integrals of both fields, and on demand their maxima, written to `ray_out`.
    ///
    /// # Errors
    /// Fails like [`StaticNetwork::record_weights`].
    pub fn record_integrals(&self, pass: &mut Pass<'_>, chunk: Chunk, maxima: bool) -> Result<()> {
        let Chunk { first_ray, n_rays } = chunk;
        let bound = [(Binding::static_sigma, self.sigma().into())];
        let push = push::MarchFwdSamples { first_ray, n_rays, with_maxima: u32::from(maxima) };
        pass.run_with(&self.kernels.march_fwd_samples, chunk.per_ray(), &bound, push)
    }

    /// Records the losses of a chunk and their gradient at each sample of both fields; [`StaticNetwork::record_integrals`] must
    /// come first.
    ///
    /// # Errors
    /// Fails like [`StaticNetwork::record_weights`].
    pub fn record_losses(&self, pass: &mut Pass<'_>, chunk: Chunk) -> Result<()> {
        let gradient = self.sigma_gradient().ok_or_else(built_for_rendering)?;
        let Chunk { first_ray, n_rays } = chunk;
        let bound = [(Binding::static_sigma, self.sigma().into()), (Binding::static_network_gradient, gradient.into())];
        let push = push::LossSamples { first_ray, n_rays };
        pass.run_with(&self.kernels.loss_samples, chunk.per_ray(), &bound, push)
    }

    /// Records the backward pass of a chunk.
    ///
    /// # Errors
    /// Fails like [`StaticNetwork::record_weights`].
    pub fn record_backward(&self, pass: &mut Pass<'_>, chunk: Chunk) -> Result<()> {
        self.with(pass, |network, pass| network.record_backward(pass, chunk))
    }

    /// Records the gradient of its parameters.
    ///
    /// # Errors
    /// Fails like [`StaticNetwork::record_weights`].
    pub fn record_gradient(&self, pass: &mut Pass<'_>) -> Result<()> {
        self.with(pass, Network::record_gradient)
    }
}
