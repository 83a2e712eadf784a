//! One training iteration, top to bottom:
//!
//! batch -> march_count -> march_scan -> march_emit -> encode -> mlp_*_fwd -> march_fwd -> loss
//! -> march_bwd, mlp_*_bwd -> reg_tv -> gradient -> adam -> report
//!
//! Nothing here waits for the host: counters, schedules and random numbers live on the device.

use super::plan::Plan;
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::memory::{Buffer, Memory};
use crate::gpu::record::{Groups, Recording};
use crate::kernels::{Buffers, Kernels, MARCH_LANES, Tuning, WEIGHT_INPUTS, dispatch, groups_for};
use crate::layout::{Frame, Ray, RayOut, Setup, View};
use crate::model::params::ParamLayout;

const ACTIVATIONS: [&str; 17] = [
    "activations_0",
    "activations_1",
    "activations_2",
    "activations_3",
    "activations_4",
    "activations_5",
    "activations_6",
    "activations_7",
    "activations_8",
    "activations_9",
    "activations_10",
    "activations_11",
    "activations_12",
    "activations_13",
    "activations_14",
    "activations_15",
    "activations_16",
];
const DZ: [&str; 2] = ["dz_even", "dz_odd"];

/// Rays handled at once: their samples fit one chunk even if all are live.
pub fn chunk_rays(setup: &Setup) -> u32 {
    (setup.sample_capacity / 64 * 64 / setup.n_dynamic_samples).max(1)
}

fn chunks(setup: &Setup, n_rays: u32) -> impl Iterator<Item = [u32; 2]> + use<> {
    let per = chunk_rays(setup).min(n_rays).max(1);
    (0..n_rays.div_ceil(per)).map(move |i| [i * per, per.min(n_rays - i * per)])
}

/// Buffers the forward passes need for batches of `n_rays`; parameters are left undefined.
///
/// # Errors
/// [`Error::OutOfMemory`] naming the buffer.
pub fn forward_buffers(
    gpu: &Gpu,
    tuning: &Tuning,
    setup: &Setup,
    params: &ParamLayout,
    n_rays: u32,
) -> Result<Buffers> {
    let mut buffers = Buffers::default();
    let per_chunk = u64::from(chunk_rays(setup).min(n_rays));
    let capacity = u64::from(setup.sample_capacity);
    let width = params.width as u64;
    let mut plain = |name: &'static str, bytes: u64| -> Result<()> {
        buffers.set(name, gpu.buffer(name, bytes, Memory::Device)?);
        Ok(())
    };
    plain("state", 16)?;
    plain("rays", u64::from(n_rays) * size_of::<Ray>() as u64)?;
    plain("ray_out", u64::from(n_rays) * size_of::<RayOut>() as u64)?;
    plain("lane_counts", per_chunk * u64::from(MARCH_LANES) * 4)?;
    plain("ray_start", (per_chunk + 1) * 4)?;
    plain("live", 16)?;
    plain("arguments", 48)?;
    plain("sample_points", capacity * 16)?;
    plain("sample_rays", capacity * 4)?;
    plain("sample_phases", capacity * 4)?;
    plain("sample_sigma", capacity * 8)?;
    plain("phase_bias", (params.layers.len() * params.phases) as u64 * width * 4)?;
    let mut operand = |name: &'static str, bytes: u64| -> Result<()> {
        buffers.set(name, gpu.operand_buffer(name, bytes, tuning.operands)?);
        Ok(())
    };
    operand("params", params.len as u64 * 4)?;
    operand("features", capacity * params.encode_groups as u64 * 16)?;
    for name in ACTIVATIONS.iter().take(params.layers.len()) {
        operand(name, capacity * width * 4)?;
    }
    let params_buffer = buffers.get("params")?.clone();
    buffers.set("static_params", params_buffer);
    buffers.set("setup", gpu.buffer_with("setup", &[*setup])?);
    Ok(buffers)
}

/// All buffers of a training run, filled from the plan; moments zero, step `step`.
///
/// # Errors
/// [`Error::OutOfMemory`] naming the buffer.
pub fn training_buffers(gpu: &Gpu, tuning: &Tuning, plan: &Plan) -> Result<Buffers> {
    let (setup, params) = (&plan.setup, &plan.params);
    let n_rays = u64::from(setup.n_rays);
    let capacity = u64::from(setup.sample_capacity);
    let per_chunk = u64::from(chunk_rays(setup)).min(n_rays);
    let network = (params.len - params.static_len) as u64;
    let mut buffers = forward_buffers(gpu, tuning, setup, params, setup.n_rays)?;
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
        ("sample_feature_gradient", capacity * 4),
        ("partials", network * u64::from(tuning.splits) * 4),
        ("ray_dz", per_chunk * params.width as u64 * 4),
        ("phase_dz", (params.layers.len() * params.phases * params.width) as u64 * 4),
        ("gradient", params.len as u64 * 4),
        ("moments", params.len as u64 * 8),
    ] {
        buffers.set(name, gpu.buffer(name, bytes, Memory::Device)?);
    }
    for name in DZ {
        buffers.set(name, gpu.operand_buffer(name, capacity * params.width as u64 * 4, tuning.operands)?);
    }
    let mut recording = Recording::new(gpu, "clear")?;
    for name in ["state", "static_gradient", "partials", "phase_dz", "gradient", "moments", "params"] {
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
pub fn record_step(recording: &mut Recording, kernels: &Kernels, buffers: &Buffers, plan: &Plan) -> Result<()> {
    let (setup, params) = (&plan.setup, &plan.params);
    let r = recording;
    dispatch(r, &kernels.batch, groups_for(&kernels.batch, setup.n_rays), buffers, &[], ())?;
    record_latents(r, kernels, buffers, params)?;
    for chunk in chunks(setup, setup.n_rays) {
        let [_, n_rays] = chunk;
        record_network(r, kernels, buffers, params, setup, chunk)?;
        dispatch(r, &kernels.march_fwd, Groups::Direct([n_rays, 1, 1]), buffers, &[], chunk)?;
        dispatch(r, &kernels.loss, groups_for(&kernels.loss, n_rays), buffers, &[], chunk)?;
        dispatch(r, &kernels.march_bwd, Groups::Direct([n_rays, 1, 1]), buffers, &[], chunk)?;
        record_network_backward(r, kernels, buffers, params, setup, chunk)?;
    }
    record_update(r, kernels, buffers, params, setup)
}

/// Records the march and the network for rays `[first, count]`: fills `sample_sigma` and `ray_start`.
fn record_network(
    r: &mut Recording,
    k: &Kernels,
    buffers: &Buffers,
    params: &ParamLayout,
    setup: &Setup,
    chunk: [u32; 2],
) -> Result<()> {
    let [first_ray, n_rays] = chunk;
    let capacity = setup.sample_capacity;
    let groups = params.width as u32 / 4;
    let encode_groups = params.encode_groups as u32;
    let per_ray = || Groups::Direct([n_rays, 1, 1]);
    dispatch(r, &k.march_count, per_ray(), buffers, &[], chunk)?;
    let (tile, width) = (k.tuning.tile(), params.width as u32);
    let (fwd_y, bwd_y) = (width.div_ceil(tile.fwd_neurons), width.div_ceil(tile.bwd_inputs));
    let scan = [n_rays, MARCH_LANES, k.tuning.tile_samples(), fwd_y, bwd_y, u32::from(first_ray > 0)];
    dispatch(r, &k.march_scan, Groups::Direct([1, 1, 1]), buffers, &[], scan)?;
    dispatch(r, &k.march_emit, per_ray(), buffers, &[], chunk)?;
    let arguments = buffers.get("arguments")?;
    let (per_sample, per_tile) = (|| Groups::Indirect(arguments, 0), || Groups::Indirect(arguments, 16));
    dispatch(r, &k.encode, per_sample(), buffers, &[], ())?;
    for (i, layer) in params.layers.iter().enumerate() {
        let previous = if i == 0 { "features" } else { ACTIVATIONS[i - 1] };
        let push = [
            layer.encoded.map_or(0, |_| encode_groups),
            layer.hidden.map_or(0, |_| groups),
            layer.encoded.unwrap_or(0) as u32 / 4,
            layer.hidden.unwrap_or(0) as u32 / 4,
            (i * params.phases * params.width) as u32,
            capacity,
            params.width as u32,
        ];
        let names = [("input_a", "features"), ("input_b", previous), ("activations", ACTIVATIONS[i])];
        dispatch(r, &k.mlp_layer_fwd, per_tile(), buffers, &names, push)?;
    }
    let last = ACTIVATIONS[params.layers.len() - 1];
    let push = [groups, params.out_weights as u32 / 4, params.out_bias as u32, capacity];
    dispatch(r, &k.mlp_out_fwd, per_sample(), buffers, &[("activations", last)], push)
}

fn record_latents(r: &mut Recording, k: &Kernels, buffers: &Buffers, params: &ParamLayout) -> Result<()> {
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
    Ok(())
}

fn record_network_backward(
    r: &mut Recording,
    k: &Kernels,
    buffers: &Buffers,
    params: &ParamLayout,
    setup: &Setup,
    chunk: [u32; 2],
) -> Result<()> {
    let [first_ray, n_rays] = chunk;
    let capacity = setup.sample_capacity;
    let (width, groups) = (params.width as u32, params.width as u32 / 4);
    let network = (params.len - params.static_len) as u32;
    let splits = k.tuning.splits;
    let accumulate = u32::from(first_ray > 0);
    let in_partials = |at: usize| (at - params.static_len) as u32;
    let arguments = buffers.get("arguments")?;
    let last = params.layers.len() - 1;
    let push = [groups, params.out_weights as u32 / 4, capacity];
    let names = [("activations", ACTIVATIONS[last]), ("dz", DZ[last % 2])];
    dispatch(r, &k.mlp_out_bwd, Groups::Indirect(arguments, 0), buffers, &names, push)?;
    let push = [in_partials(params.out_weights), in_partials(params.out_bias), capacity, splits, network, accumulate];
    let names = [("activations", ACTIVATIONS[last])];
    dispatch(r, &k.mlp_out_bwd_weight, Groups::Direct([groups, splits, 1]), buffers, &names, push)?;
    for (i, layer) in params.layers.iter().enumerate().rev() {
        let dz = DZ[i % 2];
        if let (Some(at), true) = (layer.hidden, i > 0) {
            // The input gradient goes first: nothing below writes what it reads, so the three may overlap.
            let push = [groups, groups, at as u32 / 4, capacity];
            let names = [("dz", dz), ("activations", ACTIVATIONS[i - 1]), ("dz_in", DZ[(i + 1) % 2])];
            dispatch(r, &k.mlp_layer_bwd_input, Groups::Indirect(arguments, 32), buffers, &names, push)?;
        }
        let previous = if i == 0 { "features" } else { ACTIVATIONS[i - 1] };
        let inputs = [("features", params.encode_groups as u32, layer.encoded), (previous, groups, layer.hidden)];
        for (input, in_groups, at) in inputs {
            let Some(at) = at else { continue };
            // Biases of layers without latents are summed here; the others come from the sums per phase.
            let bias = if layer.latent.is_none() { in_partials(layer.bias) } else { u32::MAX };
            let push = [in_groups, in_partials(at), capacity, splits, network, accumulate, bias, groups];
            let inputs_per_group = WEIGHT_INPUTS * k.mlp_layer_bwd_weight.local_size;
            let tiles = [
                width.div_ceil(k.tuning.tile().weight_neurons),
                (4 * in_groups).div_ceil(inputs_per_group),
                splits,
            ];
            let names = [("dz", dz), ("inputs", input)];
            dispatch(r, &k.mlp_layer_bwd_weight, Groups::Direct(tiles), buffers, &names, push)?;
        }
        if layer.latent.is_some() {
            let rays = Groups::Direct([n_rays.div_ceil(k.mlp_ray_sum.local_size), groups, 1]);
            dispatch(r, &k.mlp_ray_sum, rays, buffers, &[("dz", dz)], [n_rays, capacity])?;
            let push = [first_ray, n_rays, (i * params.phases) as u32, groups, accumulate];
            let phases = Groups::Direct([groups, params.phases as u32, 1]);
            dispatch(r, &k.mlp_phase_sum, phases, buffers, &[], push)?;
        }
    }
    Ok(())
}

fn record_update(r: &mut Recording, k: &Kernels, buffers: &Buffers, params: &ParamLayout, setup: &Setup) -> Result<()> {
    let static_len = params.static_len as u32;
    dispatch(r, &k.reg_tv, groups_for(&k.reg_tv, static_len), buffers, &[], [params.ranks as u32])?;
    let network = (params.len - params.static_len) as u32;
    let push = [0, setup.n_params, k.tuning.splits, network, static_len];
    dispatch(r, &k.gradient, groups_for(&k.gradient, setup.n_params), buffers, &[], push)?;
    let mut accumulate_latents = 0;
    for (i, layer) in params.layers.iter().enumerate() {
        let Some(latent) = layer.latent else { continue };
        let push = [i as u32, layer.bias as u32, latent as u32, params.latents as u32, accumulate_latents];
        let n = params.width + params.latent * (params.width + params.phases);
        dispatch(r, &k.mlp_latent_bwd, groups_for(&k.mlp_latent_bwd, n as u32), buffers, &[], push)?;
        accumulate_latents = 1;
    }
    dispatch(r, &k.adam, groups_for(&k.adam, setup.n_params), buffers, &[], ())?;
    dispatch(r, &k.report, Groups::Direct([1, 1, 1]), buffers, &[], ())
}

/// Records a rendering of `n_rays` rays already in `rays`: integrals and maxima land in `ray_out`.
///
/// # Errors
/// [`Error::Internal`] when a stage and its buffers do not fit.
pub fn record_render(
    recording: &mut Recording,
    kernels: &Kernels,
    buffers: &Buffers,
    params: &ParamLayout,
    setup: &Setup,
    n_rays: u32,
) -> Result<()> {
    if setup.jitter != 0 {
        return Err(Error::Internal("rendering wants regular depths".into()));
    }
    record_latents(recording, kernels, buffers, params)?;
    for chunk in chunks(setup, n_rays) {
        record_network(recording, kernels, buffers, params, setup, chunk)?;
        let per_ray = Groups::Direct([chunk[1], 1, 1]);
        dispatch(recording, &kernels.march_fwd_maxima, per_ray, buffers, &[], chunk)?;
    }
    Ok(())
}
