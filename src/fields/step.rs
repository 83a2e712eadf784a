//! One training iteration, top to bottom:
//!
//! batch -> march_count -> march_scan -> march_emit -> network forward -> march_loss -> gradient_static, network backward
//! -> gradient_network -> adam -> report
//!
//! Where the static field is a network, too, `march_fwd_samples`, `loss_samples` and its backward passes take the place of
//! `march_loss`, and its gradient that of `gradient_static`.
//!
//! Nothing here waits for the host: counters, schedules and random numbers live on the device.

use crate::error::Result;
use crate::fields::data::FieldData;
use crate::fields::images::{TrainingImages, placed};
use crate::gpu::buffer::Memory;
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::dispatch::{Binding, buffer_set};
use crate::kernels::layout::StepReport;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::tuning::Tuning;
use crate::model::params::ParamMap;
use crate::network::Network;
use crate::network::chunk::{Chunk, chunks};
use crate::network::forward::ForwardBuffers;
use crate::network::pass::Pass;

buffer_set! {
    /// Buffers of a training run beside those of the forward pass and the network.
    pub struct TrainingBuffers {
        /// [`crate::kernels::layout::View`]s of the training images.
        views,
        /// [`crate::kernels::layout::Frame`]s of the training images.
        frames,
        /// Static backgrounds of each view: lower and upper bound per pixel.
        backgrounds,
        /// Change of each pixel of each view, where two networks are the fields.
        pixel_changes,
        /// Rays that meet the hull, then those that are not hidden, where some are.
        listed_rays,
        /// [`StepReport`]s of the last iterations.
        ring,
        /// Gradient of each ray's two integrals.
        ray_gradient,
        /// Each ray's share of the losses.
        ray_loss,
        /// Each ray's share of the losses that two networks have, not weighted.
        ray_regularisers,
        /// Gradient of each sample's attenuation in the dynamic field, where two networks are the fields.
        sigma_gradient,
        /// Gradient of the static field in 64-bit fixed point.
        static_gradient,
        /// Total variation, a part per workgroup of `gradient_static`.
        tv_parts,
        /// Gradient of all parameters.
        gradient,
        /// First and second moment of each parameter's gradient.
        moments,
    }
}

impl TrainingBuffers {
    /// Creates the buffers; those that the data have no content for are left undefined.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn new(gpu: &Gpu, data: &FieldData) -> Result<TrainingBuffers> {
        let n_rays = u64::from(data.setup.n_rays);
        let two_networks = data.params.static_network.is_some();
        // Bound by kernels that do not read them then.
        let if_two = |bytes: u64| if two_networks { bytes } else { 16 };
        let static_len = if two_networks { 4 } else { data.params.static_len as u64 };
        let len = data.params.len as u64;
        let ring_bytes = u64::from(data.setup.ring_length) * size_of::<StepReport>() as u64;
        let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
        Ok(TrainingBuffers {
            views: gpu.buffer_with("views", &data.views)?,
            frames: gpu.buffer_with("frames", &placed(gpu, &data.frames, data.setup.n_pixels as usize))?,
            backgrounds: gpu.buffer_with("backgrounds", &data.backgrounds)?,
            pixel_changes: gpu.buffer_with("pixel_changes", or_one(&data.pixel_changes))?,
            listed_rays: gpu.buffer_with("listed_rays", &data.listed_rays)?,
            ring: gpu.buffer("ring", ring_bytes, Memory::Readback)?,
            ray_gradient: new(Binding::ray_gradient, n_rays * 8)?,
            ray_loss: new(Binding::ray_loss, n_rays * 16)?,
            ray_regularisers: new(Binding::ray_regularisers, if_two(n_rays * 16))?,
            sigma_gradient: new(Binding::sigma_gradient, if_two(u64::from(data.setup.sample_capacity) * 4))?,
            static_gradient: new(Binding::static_gradient, static_len * 8)?,
            tv_parts: new(Binding::tv_parts, u64::from(tv_parts(&data.params).max(1)) * 4)?,
            gradient: new(Binding::gradient, len * 4)?,
            moments: new(Binding::moments, len * 8)?,
        })
    }
}

/// Values, or one that is never read where there are none.
fn or_one(values: &[f32]) -> &[f32] {
    if values.is_empty() { &[0.0] } else { values }
}

/// Buffers of the forward pass for the batches of a fit; parameters are left undefined.
///
/// # Errors
/// [`crate::error::Error::OutOfMemory`] naming the buffer.
pub fn forward_buffers(gpu: &Gpu, tuning: &Tuning, data: &FieldData) -> Result<ForwardBuffers> {
    let (setup, schedule) = (&data.setup, gpu.buffer_with("schedule", &data.schedule)?);
    ForwardBuffers::new(gpu, tuning, setup, &data.params, setup.n_rays, schedule, data.hull.as_ref())
}

/// Starts from zero: parameters, moments, gradients, occupancy and the device's counters.
///
/// # Errors
/// Device errors.
pub fn clear<'a>(
    gpu: &Gpu,
    networks: impl IntoIterator<Item = &'a Network>,
    forward: &ForwardBuffers,
    training: &TrainingBuffers,
) -> Result<()> {
    let mut recording = Recording::new(gpu, "clear")?;
    for buffer in [&forward.state, &forward.params, &forward.occupancy] {
        recording.fill(buffer, 0);
    }
    forward.clear_samples(&mut recording);
    for buffer in [&training.static_gradient, &training.gradient, &training.moments, &training.ring] {
        recording.fill(buffer, 0);
    }
    for sums in networks.into_iter().filter_map(Network::gradient) {
        recording.fill(&sums.partials, 0);
        recording.fill(&sums.phase_dz, 0);
    }
    Ok(gpu.wait(recording.finish()?.submit()?)?)
}

/// Records one iteration on the training `images`.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_step(pass: &mut Pass<'_>, images: &TrainingImages) -> Result<()> {
    let (k, setup) = (pass.kernels, pass.setup);
    for (frames, images) in images.buffers() {
        let push = push::Batch { first_frame: frames.start, end_frame: frames.end };
        pass.run_with(&k.batch, k.batch.groups_for(setup.n_rays), &[(Binding::images, images.into())], push)?;
    }
    pass.weights()?;
    for chunk in chunks(setup, setup.n_rays) {
        pass.samples(chunk)?;
        pass.fields()?;
        record_losses(pass, chunk)?;
        if chunk.is_last(setup.n_rays) && pass.static_network.is_none() {
            // Before the network's backward passes, beside which it may run: they write none of what it does.
            record_static_gradient(pass)?;
        }
        if let Some(network) = pass.network {
            network.record_backward(pass, chunk)?;
        }
    }
    if let Some(static_network) = pass.static_network {
        // After the dynamic network's backward passes, which begin beside its last one.
        static_network.record_gradient(pass)?;
    }
    if let Some(network) = pass.network {
        network.record_gradient(pass)?;
    }
    pass.run(&k.adam, k.adam.groups_over(setup.n_params), push::Adam {})?;
    pass.run(&k.report, Groups::Direct([1, 1, 1]), push::Report { n_tv_parts: tv_parts(pass.params) })
}

/// Number of parts of the total variation, one per workgroup of `gradient_static`; 0 where the static field is a network.
pub fn tv_parts(params: &ParamMap) -> u32 {
    if params.static_network.is_some() {
        0
    } else {
        (params.static_len as u32).div_ceil(push::GradientStatic::LOCAL_SIZE)
    }
}

/// Records integrals and losses of a chunk, and the backward pass of the static field up to sums over its samples.
fn record_losses(pass: &mut Pass<'_>, chunk: Chunk) -> Result<()> {
    let (k, Chunk { first_ray, n_rays }) = (pass.kernels, chunk);
    if let Some(static_network) = pass.static_network {
        static_network.record_integrals(pass, chunk, false)?;
        static_network.record_losses(pass, chunk)?;
        return static_network.record_backward(pass, chunk);
    }
    pass.run(&k.march_loss, chunk.workgroups(k.rays_marched), push::MarchLoss { first_ray, n_rays })
}

/// Records the gradient of the tensor field's parameters.
fn record_static_gradient(pass: &mut Pass<'_>) -> Result<()> {
    let (k, params) = (pass.kernels, pass.params);
    let groups = k.gradient_static.groups_over(params.static_len as u32);
    pass.run(&k.gradient_static, groups, push::GradientStatic { ranks: params.ranks as u32 })
}
