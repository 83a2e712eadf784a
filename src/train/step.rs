//! One training iteration, top to bottom:
//!
//! batch -> march_count -> march_scan -> march_emit -> network forward -> march_fwd -> loss
//! -> march_bwd, network backward -> reg_tv -> gradient_* -> adam -> report
//!
//! Nothing here waits for the host: counters, schedules and random numbers live on the device.

use super::network::{Chunk, Network, indirect};
use super::plan::Plan;
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::memory::{Buffer, Memory};
use crate::gpu::record::{Groups, Recording};
use crate::kernels::{Buffers, Kernels, MARCH_LANES, Tuning, dispatch, groups_for};
use crate::layout::{Frame, OCCUPANCY_EPOCH, Ray, RayOut, Setup, View};
use crate::model::params::ParamLayout;

/// Rays handled at once: their samples fit one chunk even if all are live.
pub fn chunk_rays(setup: &Setup) -> u32 {
    (setup.sample_capacity / 128 * 128 / setup.n_dynamic_samples).max(1)
}

fn chunks(setup: &Setup, n_rays: u32) -> impl Iterator<Item = Chunk> + use<> {
    let per = chunk_rays(setup).min(n_rays).max(1);
    (0..n_rays.div_ceil(per)).map(move |i| Chunk { first_ray: i * per, n_rays: per.min(n_rays - i * per) })
}

/// Bytes of the three epochs of occupancy; none without it.
pub fn occupancy_bytes(setup: &Setup) -> u64 {
    if setup.occupancy_cells > 0 { 3 * 4 * setup.occupancy_words() as u64 } else { 0 }
}

/// Buffers the forward passes need for batches of `n_rays`; parameters are left undefined.
///
/// # Errors
/// [`Error::OutOfMemory`] naming the buffer.
pub fn forward_buffers(
    gpu: &Gpu,
    tuning: &Tuning,
    network: &Network,
    setup: &Setup,
    params: &ParamLayout,
    n_rays: u32,
) -> Result<Buffers> {
    let mut buffers = Buffers::default();
    // Samplers of volumes may have fewer samples a ray and more rays a chunk than `setup` says.
    let per_chunk = u64::from(n_rays);
    let capacity = u64::from(setup.sample_capacity);
    // A bit per sample, each lane's rounded up to words.
    let mask_words = capacity / 32 + per_chunk * u64::from(MARCH_LANES);
    for (name, bytes) in [
        ("state", 16),
        ("rays", u64::from(n_rays) * size_of::<Ray>() as u64),
        ("ray_out", u64::from(n_rays) * size_of::<RayOut>() as u64),
        ("lane_masks", mask_words * 4),
        ("lane_offsets", per_chunk * u64::from(MARCH_LANES) * 4),
        ("ray_counts", per_chunk * 4),
        ("ray_start", (per_chunk + 1) * 4),
        ("live", 16),
        ("arguments", 48),
        ("sample_points", capacity * 16),
        ("sample_rays", capacity * 4),
        ("sample_sigma", capacity * 8),
        ("occupancy", occupancy_bytes(setup)),
        ("phase_bias", (params.layers.len() * params.phases * params.width) as u64 * 4),
    ] {
        buffers.set(name, gpu.buffer(name, bytes, Memory::Device)?);
    }
    let params_buffer = gpu.operand_buffer("params", params.len as u64 * 4, tuning.operands)?;
    buffers.set("static_params", params_buffer.clone());
    buffers.set("params", params_buffer);
    buffers.set("setup", gpu.buffer_with("setup", &[*setup])?);
    network.forward_buffers(gpu, tuning, setup, params, &mut buffers)?;
    Ok(buffers)
}

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
    buffers.set("ring", gpu.buffer("ring", u64::from(setup.ring_length) * 32, Memory::Readback)?);
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

/// The hull's cells as the shaders read them; a single empty word without a hull.
///
/// # Errors
/// [`Error::OutOfMemory`].
pub fn hull_buffer(gpu: &Gpu, hull: Option<&crate::data::motion::Hull>) -> Result<Buffer> {
    gpu.buffer_with("hull", hull.map_or(&[0][..], |h| &h.bits))
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
            dispatch(r, &k.occupancy_mark, indirect(buffers, 0)?, buffers, &[], ())?;
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

/// Records the live dynamic samples of a chunk: counts, offsets and indirect arguments, points.
fn record_samples(
    r: &mut Recording,
    k: &Kernels,
    network: &Network,
    buffers: &Buffers,
    params: &ParamLayout,
    chunk: Chunk,
) -> Result<()> {
    let per_ray = || Groups::Direct([chunk.n_rays, 1, 1]);
    dispatch(r, &k.march_count, per_ray(), buffers, &[], chunk.push())?;
    dispatch(r, &k.march_scan, Groups::Direct([1, 1, 1]), buffers, &[], network.scan(params, chunk))?;
    dispatch(r, &k.march_emit, per_ray(), buffers, &[], chunk.push())
}

/// Records the dynamic field at the live samples of `n_rays` rays already in `rays`, put into the rows of `volume`.
///
/// # Errors
/// [`Error::Internal`] when a stage and its buffers do not fit.
pub fn record_volume(
    r: &mut Recording,
    k: &Kernels,
    network: &Network,
    buffers: &Buffers,
    params: &ParamLayout,
    setup: &Setup,
    n_rays: u32,
) -> Result<()> {
    network.record_weights(r, k, buffers, params)?;
    for chunk in chunks(setup, n_rays) {
        record_samples(r, k, network, buffers, params, chunk)?;
        network.record_forward(r, buffers, params, setup)?;
        dispatch(r, &k.volume_dynamic, indirect(buffers, 0)?, buffers, &[], ())?;
    }
    Ok(())
}

/// Records a rendering of `n_rays` rays already in `rays`: integrals and maxima land in `ray_out`.
///
/// # Errors
/// [`Error::Internal`] when a stage and its buffers do not fit.
pub fn record_render(
    r: &mut Recording,
    k: &Kernels,
    network: &Network,
    buffers: &Buffers,
    params: &ParamLayout,
    setup: &Setup,
    n_rays: u32,
) -> Result<()> {
    if setup.jitter != 0 {
        return Err(Error::Internal("rendering wants regular depths".into()));
    }
    network.record_weights(r, k, buffers, params)?;
    for chunk in chunks(setup, n_rays) {
        record_samples(r, k, network, buffers, params, chunk)?;
        network.record_forward(r, buffers, params, setup)?;
        let per_ray = Groups::Direct([chunk.n_rays, 1, 1]);
        dispatch(r, &k.march_fwd_maxima, per_ray, buffers, &[], chunk.push())?;
    }
    Ok(())
}
