//! One training iteration, top to bottom:
//!
//! batch -> march_count -> march_scan -> march_emit -> network forward -> march_fwd -> loss
//! -> march_bwd, network backward -> reg_tv -> gradient_* -> adam -> report
//!
//! Nothing here waits for the host: counters, schedules and random numbers live on the device.

use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::gpu::memory::Memory;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::constants::OCCUPANCY_EPOCH;
use crate::kernels::dispatch::{Buffers, dispatch, groups_for};
use crate::kernels::layout::{Frame, IndirectArguments, StepReport, View};
use crate::kernels::stages::Kernels;
use crate::kernels::tuning::Tuning;
use crate::network::chunk::{chunk_rays, chunks};
use crate::network::forward::{forward_buffers, hull_buffer, record_samples};
use crate::network::{Network, indirect};
use crate::plan::Plan;
use std::mem::offset_of;

/// All buffers of a training run, filled from the plan; moments zero, step 0.
///
/// # Errors
/// [`Error::OutOfMemory`] naming the buffer.
pub fn training_buffers(gpu: &Gpu, tuning: &Tuning, network: &Network, plan: &Plan) -> Result<Buffers> {
    let (setup, params) = (&plan.setup, &plan.params);
    let n_rays = u64::from(setup.n_rays);
    let mut buffers = forward_buffers(gpu, tuning, network, setup, params, setup.n_rays)?;
    buffers.set("schedule", gpu.buffer_with("schedule", &plan.schedule)?);
    buffers.set("views", gpu.buffer_with::<View>("views", &plan.views)?);
    buffers.set("frames", gpu.buffer_with::<Frame>("frames", &plan.frames)?);
    buffers.set("images", gpu.buffer_with("images", &plan.images)?);
    buffers.set("backgrounds", gpu.buffer_with("backgrounds", &plan.backgrounds)?);
    buffers.set("motion_rays", gpu.buffer_with("motion_rays", &plan.motion_rays)?);
    buffers.set("hull", hull_buffer(gpu, plan.hull.as_ref())?);
    buffers.set(
        "ring",
        gpu.buffer("ring", u64::from(setup.ring_length) * size_of::<StepReport>() as u64, Memory::Readback)?,
    );
    for (name, bytes) in [
        ("ray_gradient", n_rays * 8),
        ("ray_loss", n_rays * 16),
        ("static_gradient", params.static_len as u64 * 8),
        ("tv_gradient", params.static_len as u64 * 4),
        ("tv_value", params.static_len as u64 * 4),
        ("phase_dz", (params.layers.len() * params.phases * params.width) as u64 * 4),
        ("gradient", params.len as u64 * 4),
        ("moments", params.len as u64 * 8),
    ] {
        buffers.set(name, gpu.buffer(name, bytes, Memory::Device)?);
    }
    let rays_per_chunk = u64::from(chunk_rays(setup)).min(n_rays);
    network.backward_buffers(gpu, tuning, setup, params, rays_per_chunk, &mut buffers)?;
    let mut recording = Recording::new(gpu, "clear")?;
    for name in ["state", "static_gradient", "partials", "phase_dz", "gradient", "moments", "params", "occupancy"] {
        recording.fill(buffers.get(name)?, 0);
    }
    gpu.wait(recording.finish()?.submit()?)?;
    Ok(buffers)
}

/// Records one iteration.
///
/// # Errors
/// [`Error::Internal`] when a stage and its buffers do not fit.
pub fn record_step(r: &mut Recording, k: &Kernels, network: &Network, buffers: &Buffers, plan: &Plan) -> Result<()> {
    let (setup, params) = (&plan.setup, &plan.params);
    dispatch(r, &k.batch, groups_for(&k.batch, setup.n_rays), buffers, &[], ())?;
    network.record_weights(r, k, buffers, params)?;
    for chunk in chunks(setup, setup.n_rays) {
        let per_ray = || Groups::Direct([chunk.n_rays, 1, 1]);
        record_samples(r, k, network, buffers, params, chunk)?;
        network.record_forward(r, buffers, params, setup)?;
        if setup.occupancy_cells > 0 {
            dispatch(
                r,
                &k.occupancy_mark,
                indirect(buffers, offset_of!(IndirectArguments, samples))?,
                buffers,
                &[],
                (),
            )?;
        }
        dispatch(r, &k.march_fwd, per_ray(), buffers, &[], chunk.push())?;
        dispatch(r, &k.loss, groups_for(&k.loss, chunk.n_rays), buffers, &[], chunk.push())?;
        dispatch(r, &k.march_bwd, per_ray(), buffers, &[], chunk.push())?;
        network.record_backward(r, buffers, params, setup, chunk)?;
    }
    let static_len = params.static_len as u32;
    dispatch(r, &k.reg_tv, groups_for(&k.reg_tv, static_len), buffers, &[], [params.ranks as u32])?;
    dispatch(r, &k.gradient_static, groups_for(&k.gradient_static, static_len), buffers, &[], ())?;
    network.record_gradient(r, k, buffers, params)?;
    if setup.occupancy_cells > 0 {
        let slice = (setup.occupancy_words() as u32).div_ceil(OCCUPANCY_EPOCH);
        dispatch(r, &k.occupancy_clear, groups_for(&k.occupancy_clear, slice), buffers, &[], ())?;
    }
    dispatch(r, &k.adam, groups_for(&k.adam, setup.n_params), buffers, &[], ())?;
    dispatch(r, &k.report, Groups::Direct([1, 1, 1]), buffers, &[], ())
}
