//! The forward pass of a batch: live samples, network, integrals. What training and rendering share.

use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::memory::{Buffer, Memory};
use crate::gpu::record::{Groups, Recording};
use crate::kernels::constants::OCCUPANCY_EPOCHS;
use crate::kernels::dispatch::{Buffers, dispatch};
use crate::kernels::layout::{DeviceState, IndirectArguments, LiveSamples, Ray, RayOut, Setup};
use crate::kernels::stages::{Kernels, MARCH_LANES};
use crate::kernels::tuning::Tuning;
use crate::model::params::ParamLayout;
use crate::network::chunk::{Chunk, chunks};
use crate::network::{Network, indirect};
use std::mem::offset_of;

/// Bytes of the three epochs of occupancy; none without it.
pub fn occupancy_bytes(setup: &Setup) -> u64 {
    if setup.occupancy_cells > 0 { u64::from(OCCUPANCY_EPOCHS) * 4 * setup.occupancy_words() as u64 } else { 0 }
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
        ("state", size_of::<DeviceState>() as u64),
        ("rays", u64::from(n_rays) * size_of::<Ray>() as u64),
        ("ray_out", u64::from(n_rays) * size_of::<RayOut>() as u64),
        ("lane_masks", mask_words * 4),
        ("lane_offsets", per_chunk * u64::from(MARCH_LANES) * 4),
        ("ray_counts", per_chunk * 4),
        ("ray_start", (per_chunk + 1) * 4),
        ("live", size_of::<LiveSamples>() as u64),
        ("arguments", size_of::<IndirectArguments>() as u64),
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

/// The hull's cells as the shaders read them; a single empty word without a hull.
///
/// # Errors
/// [`Error::OutOfMemory`].
pub fn hull_buffer(gpu: &Gpu, hull: Option<&crate::model::hull::Hull>) -> Result<Buffer> {
    gpu.buffer_with("hull", hull.map_or(&[0][..], |h| &h.bits))
}

/// Records the live dynamic samples of a chunk: counts, offsets and indirect arguments, points.
pub fn record_samples(
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
        dispatch(r, &k.volume_dynamic, indirect(buffers, offset_of!(IndirectArguments, samples))?, buffers, &[], ())?;
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
