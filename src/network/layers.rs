//! The network in f32, one pass per layer: runs on every device, and is the yardstick for [`super::fused`].

use crate::error::Result;
use crate::gpu::device::Gpu;
use crate::gpu::memory::Memory;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::constants::NOWHERE;
use crate::kernels::dispatch::{Buffers, dispatch};
use crate::kernels::layout::{IndirectArguments, Setup};
use crate::kernels::stages::{LayerKernels, WEIGHT_INPUTS};
use crate::kernels::tuning::Tuning;
use crate::model::params::ParamLayout;
use crate::network::chunk::Chunk;
use crate::network::indirect;
use std::mem::offset_of;

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

/// Adds the buffers of the forward pass.
pub fn forward_buffers(
    gpu: &Gpu,
    tuning: &Tuning,
    setup: &Setup,
    params: &ParamLayout,
    buffers: &mut Buffers,
) -> Result<()> {
    let capacity = u64::from(setup.sample_capacity);
    buffers.set("sample_phases", gpu.buffer("sample_phases", capacity * 4, Memory::Device)?);
    let mut operand = |name: &'static str, bytes: u64| -> Result<()> {
        buffers.set(name, gpu.operand_buffer(name, bytes, tuning.operands)?);
        Ok(())
    };
    operand("features", capacity * params.encode_groups as u64 * 16)?;
    for name in ACTIVATIONS.iter().take(params.layers.len()) {
        operand(name, capacity * params.width as u64 * 4)?;
    }
    Ok(())
}

/// Adds the buffers of the backward pass, and what `gradient_network` needs to know of the partial sums.
pub fn backward_buffers(
    gpu: &Gpu,
    tuning: &Tuning,
    setup: &Setup,
    params: &ParamLayout,
    rays_per_chunk: u64,
    buffers: &mut Buffers,
) -> Result<()> {
    let capacity = u64::from(setup.sample_capacity);
    let network = params.network_len() as u64;
    for (name, bytes) in [
        ("sample_feature_gradient", capacity * 4),
        ("partials", network * u64::from(tuning.splits) * 4),
        ("ray_dz", rays_per_chunk * params.width as u64 * 4),
    ] {
        buffers.set(name, gpu.buffer(name, bytes, Memory::Device)?);
    }
    for name in DZ {
        let bytes = capacity * params.width as u64 * 4;
        buffers.set(name, gpu.operand_buffer(name, bytes, tuning.operands)?);
    }
    let in_order: Vec<u32> = (0..network as u32).collect();
    buffers.set("gradient_source", gpu.buffer_with("gradient_source", &in_order)?);
    Ok(())
}

/// Records `encode`, `mlp_layer_fwd` of each layer and `mlp_out_fwd`.
pub fn record_forward(
    r: &mut Recording,
    k: &LayerKernels,
    buffers: &Buffers,
    params: &ParamLayout,
    setup: &Setup,
) -> Result<()> {
    let capacity = setup.sample_capacity;
    let (groups, encode_groups) = (params.width as u32 / 4, params.encode_groups as u32);
    let (per_sample, per_tile) = (
        || indirect(buffers, offset_of!(IndirectArguments, samples)),
        || indirect(buffers, offset_of!(IndirectArguments, forward_tiles)),
    );
    dispatch(r, &k.encode, per_sample()?, buffers, &[], ())?;
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
        dispatch(r, &k.mlp_layer_fwd, per_tile()?, buffers, &names, push)?;
    }
    let last = ACTIVATIONS[params.layers.len() - 1];
    let push = [groups, params.out_weights as u32 / 4, params.out_bias as u32, capacity];
    dispatch(r, &k.mlp_out_fwd, per_sample()?, buffers, &[("activations", last)], push)
}

/// Records the backward pass of a chunk: `partials` and `phase_dz`.
pub fn record_backward(
    r: &mut Recording,
    k: &LayerKernels,
    buffers: &Buffers,
    params: &ParamLayout,
    setup: &Setup,
    chunk: Chunk,
) -> Result<()> {
    let capacity = setup.sample_capacity;
    let (width, groups) = (params.width as u32, params.width as u32 / 4);
    let network = params.network_len() as u32;
    let splits = k.tuning.splits;
    let accumulate = u32::from(chunk.first_ray > 0);
    let in_partials = |at: usize| (at - params.static_len) as u32;
    let last = params.layers.len() - 1;
    let push = [groups, params.out_weights as u32 / 4, capacity];
    let names = [("activations", ACTIVATIONS[last]), ("dz", DZ[last % 2])];
    dispatch(r, &k.mlp_out_bwd, indirect(buffers, offset_of!(IndirectArguments, samples))?, buffers, &names, push)?;
    let push = [in_partials(params.out_weights), in_partials(params.out_bias), capacity, splits, network, accumulate];
    let names = [("activations", ACTIVATIONS[last])];
    dispatch(r, &k.mlp_out_bwd_weight, Groups::Direct([groups, splits, 1]), buffers, &names, push)?;
    for (i, layer) in params.layers.iter().enumerate().rev() {
        let dz = DZ[i % 2];
        if let (Some(at), true) = (layer.hidden, i > 0) {
            // The input gradient goes first: nothing below writes what it reads, so the three may overlap.
            let push = [groups, groups, at as u32 / 4, capacity];
            let names = [("dz", dz), ("activations", ACTIVATIONS[i - 1]), ("dz_in", DZ[(i + 1) % 2])];
            dispatch(
                r,
                &k.mlp_layer_bwd_input,
                indirect(buffers, offset_of!(IndirectArguments, backward_tiles))?,
                buffers,
                &names,
                push,
            )?;
        }
        let previous = if i == 0 { "features" } else { ACTIVATIONS[i - 1] };
        let inputs = [("features", params.encode_groups as u32, layer.encoded), (previous, groups, layer.hidden)];
        for (input, in_groups, at) in inputs {
            let Some(at) = at else { continue };
            // Biases of layers without latents are summed here; the others come from the sums per phase.
            let bias = if layer.latent.is_none() { in_partials(layer.bias) } else { NOWHERE };
            let push = [in_groups, in_partials(at), capacity, splits, network, accumulate, bias, groups];
            let inputs_per_group = WEIGHT_INPUTS * k.mlp_layer_bwd_weight.local_size;
            let tiles =
                [width.div_ceil(k.tuning.tile().weight_neurons), (4 * in_groups).div_ceil(inputs_per_group), splits];
            let names = [("dz", dz), ("inputs", input)];
            dispatch(r, &k.mlp_layer_bwd_weight, Groups::Direct(tiles), buffers, &names, push)?;
        }
        if layer.latent.is_some() {
            let rays = Groups::Direct([chunk.n_rays.div_ceil(k.mlp_ray_sum.local_size), groups, 1]);
            dispatch(r, &k.mlp_ray_sum, rays, buffers, &[("dz", dz)], [chunk.n_rays, capacity])?;
            let push = [chunk.first_ray, chunk.n_rays, (i * params.phases) as u32, groups, accumulate];
            let phases = Groups::Direct([groups, params.phases as u32, 1]);
            dispatch(r, &k.mlp_phase_sum, phases, buffers, &[], push)?;
        }
    }
    Ok(())
}
