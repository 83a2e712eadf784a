//! The network on cooperative matrices: f16 operands, f32 sums, f32 master parameters. One pass forward, one or two
//! per layer backward.
//!
//! A layer that sees the input has one weight matrix on `[encoding, one-hot phase, zeros]`: the columns of the phases
//! hold bias and latent contribution, so that their gradient, summed per phase, is part of the weight gradient.
//!
//! Gradients are multiplied by a loss scale (`state.loss_scale`) before they become f16 and divided by it after the sums.
//! A sum that is not finite skips the update and halves the scale; many good ones double it (`report`).

use crate::error::{Error, Result};
use crate::gpu::capabilities::{DeviceInfo, MatrixShape};
use crate::gpu::device::Gpu;
use crate::gpu::memory::Memory;
use crate::gpu::pipeline::Pipeline;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::constants::{NOWHERE, PHASE_BIAS};
use crate::kernels::dispatch::{Buffers, dispatch, groups_for};
use crate::kernels::layout::{IndirectArguments, Setup};
use crate::kernels::stages::kernel_code;
use crate::kernels::tuning::Tuning;
use crate::model::params::ParamLayout;
use crate::network::chunk::Chunk;
use crate::network::indirect;
use std::mem::offset_of;
use std::sync::Arc;

/// Shared memory beside the tiles, bytes.
const SHARED_RESERVE: u32 = 512;
const DZ: [&str; 2] = ["dz16_even", "dz16_odd"];

/// Positions of one hidden layer in the packed weights, which are also those of its gradient in the partial sums.
#[derive(Debug, Clone, PartialEq, Eq)]
struct PackedLayer {
    /// `[width][encoded]`.
    encoded: Option<usize>,
    /// `[width][width]`.
    hidden: Option<usize>,
    /// `[width]`, in the partial sums only.
    bias: Option<usize>,
}

/// Sizes and positions, from the network's shape and the device's limits.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Shape {
    matrix: MatrixShape,
    subgroups: u32,
    fwd_tile: u32,
    bwd_tile: u32,
    /// Columns of the weights on the encoding: numbers, phases, padding.
    encoded: usize,
    layers: Vec<PackedLayer>,
    /// Output weights: `n` rows of `[width]` in the packed weights, the first of them in the partial sums.
    out_weights: usize,
    weights_len: usize,
    /// Output bias in the partial sums.
    out_bias: usize,
    partials_len: usize,
}

impl Shape {
    /// # Errors
    /// [`Error::Config`] when the network does not fit the device's shared memory or workgroups.
    fn new(info: &DeviceInfo, matrix: MatrixShape, largest: u32, params: &ParamLayout) -> Result<Shape> {
        let MatrixShape { m, n, k } = matrix;
        let width = params.width as u32;
        let encoded = (params.encoded_len + params.phases).next_multiple_of(16);
        let unfit = |what: String| Error::config("dynamic.width", width, what);
        let subgroups = (1..=8).rev().find(|s| (width / n).is_multiple_of(*s)).unwrap_or(1);
        if subgroups * info.subgroup_size < width / 8 {
            return Err(unfit("is too wide for the matrix kernels on this device".into()));
        }
        let skips = params.layers.iter().skip(1).any(|l| l.encoded.is_some());
        let budget = info.max_shared_memory - SHARED_RESERVE;
        let tile_within = |largest: u32, bytes: &dyn Fn(u32) -> u32| {
            let tiles = [128, 64, 32, 16].into_iter().filter(|t| *t <= largest && t % m == 0 && t % k == 0);
            tiles.into_iter().find(|t| bytes(*t) <= budget)
        };
        let row = |columns: u32| 16 * (columns / 8 + 1);
        let (hidden_row, encoded_row) = (row(width), row(encoded as u32));
        let rows = if skips { hidden_row + encoded_row } else { hidden_row.max(encoded_row) };
        let fwd_tile = tile_within(largest, &|t| t * (rows + 4 * n));
        let scratch = 2 * 16 * subgroups * info.subgroup_size;
        let bwd_tile =
            tile_within(largest.min(64), &|t| (t * hidden_row).max(scratch) + t * (hidden_row.max(encoded_row) + 4));
        let (Some(fwd_tile), Some(bwd_tile)) = (fwd_tile, bwd_tile) else {
            return Err(unfit(format!("needs more than the {} KiB of shared memory", info.max_shared_memory >> 10)));
        };
        let mut next = 0;
        let mut take = |len: usize| {
            next += len;
            next - len
        };
        let mut layers: Vec<PackedLayer> = params
            .layers
            .iter()
            .map(|layer| PackedLayer {
                encoded: layer.encoded.map(|_| take(params.width * encoded)),
                hidden: layer.hidden.map(|_| take(params.width * params.width)),
                bias: None,
            })
            .collect();
        let out_weights = take(params.width * n as usize);
        let weights_len = take(0);
        for (packed, layer) in layers.iter_mut().zip(&params.layers) {
            packed.bias = layer.latent.is_none().then(|| take(params.width));
        }
        let out_bias = take(16);
        let partials_len = take(0);
        Ok(Shape {
            matrix,
            subgroups,
            fwd_tile,
            bwd_tile,
            encoded,
            layers,
            out_weights,
            weights_len,
            out_bias,
            partials_len,
        })
    }

    /// Where each packed weight, then each row of biases, comes from.
    fn pack_source(&self, params: &ParamLayout) -> Vec<u32> {
        let mut source = vec![NOWHERE; self.weights_len];
        let width = params.width;
        let phase_bias =
            |layer: usize, phase: usize, j: usize| PHASE_BIAS | ((layer * params.phases + phase) * width + j) as u32;
        for (l, (packed, layer)) in self.layers.iter().zip(&params.layers).enumerate() {
            for j in 0..width {
                if let (Some(to), Some(from)) = (packed.encoded, layer.encoded) {
                    let row = &mut source[to + j * self.encoded..][..self.encoded];
                    for (c, s) in row[..params.encoded_len].iter_mut().enumerate() {
                        *s = (from + j * 4 * params.encode_groups + c) as u32;
                    }
                    for (phase, s) in row[params.encoded_len..][..params.phases].iter_mut().enumerate() {
                        *s = phase_bias(l, phase, j);
                    }
                }
                if let (Some(to), Some(from)) = (packed.hidden, layer.hidden) {
                    for c in 0..width {
                        source[to + j * width + c] = (from + j * width + c) as u32;
                    }
                }
            }
        }
        for j in 0..width {
            source[self.out_weights + j] = (params.out_weights + j) as u32;
        }
        for layer in &params.layers {
            for _ in 0..self.matrix.m {
                source.extend((0..width).map(|j| match layer.latent {
                    Some(_) => NOWHERE,
                    None => (layer.bias + j) as u32,
                }));
            }
        }
        source
    }

    /// Where the gradient of each network parameter lies in the partial sums.
    fn gradient_source(&self, params: &ParamLayout) -> Vec<u32> {
        let mut source = vec![NOWHERE; params.network_len()];
        let width = params.width;
        let mut put = |at: usize, from: usize| source[at - params.static_len] = from as u32;
        for (packed, layer) in self.layers.iter().zip(&params.layers) {
            for j in 0..width {
                if let (Some(from), Some(to)) = (packed.encoded, layer.encoded) {
                    for c in 0..params.encoded_len {
                        put(to + j * 4 * params.encode_groups + c, from + j * self.encoded + c);
                    }
                }
                if let (Some(from), Some(to)) = (packed.hidden, layer.hidden) {
                    (0..width).for_each(|c| put(to + j * width + c, from + j * width + c));
                }
                if let Some(from) = packed.bias {
                    put(layer.bias + j, from + j);
                }
            }
        }
        (0..width).for_each(|j| put(params.out_weights + j, self.out_weights + j));
        put(params.out_bias, self.out_bias);
        source
    }

    /// Where the sum of dz over each phase, `[layer][phase][neuron]`, lies in the partial sums.
    fn phase_source(&self, params: &ParamLayout) -> Vec<u32> {
        let mut source = Vec::new();
        for packed in &self.layers {
            for phase in 0..params.phases {
                source.extend((0..params.width).map(|j| match packed.encoded {
                    Some(from) => (from + j * self.encoded + params.encoded_len + phase) as u32,
                    None => NOWHERE,
                }));
            }
        }
        source
    }
}

/// Pipelines of the fused network.
pub struct FusedKernels {
    shape: Shape,
    /// Workgroups of the backward passes, each with its own partial sums.
    pub workgroups: u32,
    mlp_pack: Arc<Pipeline>,
    mlp_fused_fwd: Arc<Pipeline>,
    backward: Option<Backward>,
}

struct Backward {
    /// Through the last hidden layer, whose dz it forms.
    last: Arc<Pipeline>,
    /// Through the others.
    hidden: Arc<Pipeline>,
    /// Weights on the encoding.
    encoded: Arc<Pipeline>,
    /// The same for the last hidden layer.
    last_encoded: Arc<Pipeline>,
}

impl FusedKernels {
    /// Builds the pipelines; `train` includes the backward passes.
    ///
    /// # Errors
    /// [`Error::Config`] when device and network do not fit; errors of [`Gpu::matrix_pipeline`].
    pub fn new(gpu: &Gpu, tuning: &Tuning, params: &ParamLayout, train: bool) -> Result<FusedKernels> {
        let info = gpu.info();
        let matrix = *info.matrices.first().ok_or_else(|| {
            let problem = "this device has no cooperative matrices our kernels can use: take f32 or auto";
            Error::config("layers", "matrices", format!("{}: {problem}", info.name))
        })?;
        let shape = Shape::new(info, matrix, tuning.matrices.largest_tile, params)?;
        let local = shape.subgroups * info.subgroup_size;
        let variant = if tuning.matrices.unroll { "_unrolled" } else { "" };
        let common = |tile: u32| {
            [
                ("m", matrix.m),
                ("n", matrix.n),
                ("k", matrix.k),
                ("tile", tile),
                ("subgroups", shape.subgroups),
                ("width", params.width as u32),
            ]
        };
        let skip = params.layers.iter().skip(1).position(|l| l.encoded.is_some()).map_or(0, |i| i + 1);
        let mut spec = common(shape.fwd_tile).to_vec();
        spec.extend([
            ("encoded", shape.encoded as u32),
            ("layers", params.layers.len() as u32),
            ("skip", skip as u32),
            ("keep", u32::from(train)),
        ]);
        let forward = gpu.matrix_pipeline(kernel_code(&format!("mlp_fused_fwd{variant}"))?, local, &spec)?;
        let backward = |columns: usize, with_input: bool, from_output: bool| {
            let mut spec = common(shape.bwd_tile).to_vec();
            spec.extend([
                ("columns", columns as u32),
                ("with_input", u32::from(with_input)),
                ("from_output", u32::from(from_output)),
                (
                    "halves",
                    if shape.subgroups.is_multiple_of(2) && (columns as u32 / matrix.n).is_multiple_of(2) {
                        2
                    } else {
                        1
                    },
                ),
            ]);
            let code = kernel_code(&format!("mlp_fused_bwd{variant}"))?;
            gpu.matrix_pipeline(code, local, &spec).map(Arc::new)
        };
        Ok(FusedKernels {
            workgroups: tuning.matrices.workgroups,
            mlp_pack: Arc::new(gpu.pipeline(kernel_code("mlp_pack")?, 64, &[])?),
            mlp_fused_fwd: Arc::new(forward),
            backward: if train {
                Some(Backward {
                    last: backward(params.width, true, true)?,
                    hidden: backward(params.width, true, false)?,
                    encoded: backward(shape.encoded, false, false)?,
                    last_encoded: backward(shape.encoded, false, true)?,
                })
            } else {
                None
            },
            shape,
        })
    }

    /// Samples a workgroup of the forward pass covers.
    pub fn tile_samples(&self) -> u32 {
        self.shape.fwd_tile
    }

    /// Elements of a workgroup's partial sums.
    pub fn partials_len(&self) -> u32 {
        self.shape.partials_len as u32
    }

    /// Adds the buffers of the forward pass.
    pub fn forward_buffers(&self, gpu: &Gpu, setup: &Setup, params: &ParamLayout, buffers: &mut Buffers) -> Result<()> {
        let shape = &self.shape;
        let kept = |per_sample: usize| match self.backward {
            Some(_) => u64::from(setup.sample_capacity) * per_sample as u64 * 2,
            None => 16,
        };
        let bias_len = params.layers.len() * shape.matrix.m as usize * params.width;
        for (name, bytes) in [
            ("weights16", shape.weights_len as u64 * 2),
            ("bias_rows", bias_len as u64 * 4),
            ("features16", kept(shape.encoded)),
            ("activations16", kept(params.layers.len() * params.width)),
        ] {
            buffers.set(name, gpu.buffer(name, bytes, Memory::Device)?);
        }
        buffers.set("pack_source", gpu.buffer_with("pack_source", &shape.pack_source(params))?);
        Ok(())
    }

    /// Adds the buffers of the backward pass, and what `gradient_network` needs to know of the partial sums.
    pub fn backward_buffers(
        &self,
        gpu: &Gpu,
        setup: &Setup,
        params: &ParamLayout,
        buffers: &mut Buffers,
    ) -> Result<()> {
        let shape = &self.shape;
        let dz_bytes = u64::from(setup.sample_capacity) * params.width as u64 * 2;
        for name in DZ {
            buffers.set(name, gpu.buffer(name, dz_bytes, Memory::Device)?);
        }
        let bytes = u64::from(self.workgroups) * shape.partials_len as u64 * 4;
        buffers.set("partials", gpu.buffer("partials", bytes, Memory::Device)?);
        buffers.set("gradient_source", gpu.buffer_with("gradient_source", &shape.gradient_source(params))?);
        buffers.set("phase_source", gpu.buffer_with("phase_source", &shape.phase_source(params))?);
        Ok(())
    }

    /// Records the f16 copies of the weights; `phase_bias` must be there.
    pub fn record_pack(&self, r: &mut Recording, buffers: &Buffers, params: &ParamLayout) -> Result<()> {
        let pairs = (self.shape.weights_len / 2) as u32;
        let bias = params.layers.len() as u32 * self.shape.matrix.m * params.width as u32;
        let groups = groups_for(&self.mlp_pack, pairs + bias);
        dispatch(r, &self.mlp_pack, groups, buffers, &[], [pairs, bias])
    }

    /// Records the forward pass: `sample_sigma`.
    pub fn record_forward(&self, r: &mut Recording, buffers: &Buffers, params: &ParamLayout) -> Result<()> {
        dispatch(
            r,
            &self.mlp_fused_fwd,
            indirect(buffers, offset_of!(IndirectArguments, forward_tiles))?,
            buffers,
            &[],
            params.out_bias as u32,
        )
    }

    /// Records the backward pass of a chunk: `partials`.
    pub fn record_backward(
        &self,
        r: &mut Recording,
        buffers: &Buffers,
        params: &ParamLayout,
        setup: &Setup,
        chunk: Chunk,
    ) -> Result<()> {
        let shape = &self.shape;
        let k = self.backward.as_ref().ok_or_else(|| Error::Internal("built for rendering only".into()))?;
        let accumulate = u32::from(chunk.first_ray > 0);
        let layer_activations = |l: usize| l as u32 * setup.sample_capacity * params.width as u32 / 8;
        let last = params.layers.len() - 1;
        let position = |at: Option<usize>| at.map_or(NOWHERE, |at| at as u32);
        for (l, packed) in shape.layers.iter().enumerate().rev() {
            let (dz, below) = (DZ[l % 2], DZ[(l + 1) % 2]);
            let is_last = l == last;
            let parts = [
                (packed.hidden, "activations16", if is_last { &k.last } else { &k.hidden }),
                (packed.encoded, "features16", if is_last { &k.last_encoded } else { &k.encoded }),
            ];
            let mut bias = packed.bias;
            let mut out = is_last.then_some((shape.out_weights, shape.out_bias));
            for (at, input, stage) in parts {
                let Some(at) = at else { continue };
                // The first pass over a layer's dz also sums what depends on dz alone.
                let (out_weights, out_bias) = out.take().unzip();
                let push = [
                    at as u32,
                    if input == "features16" { 0 } else { layer_activations(l - 1) },
                    layer_activations(l),
                    shape.out_weights as u32,
                    shape.partials_len as u32,
                    at as u32,
                    position(bias.take()),
                    position(out_weights),
                    position(out_bias),
                    accumulate,
                ];
                let names = [("inputs16", input), ("outputs16", "activations16"), ("dz16", dz), ("dz_in16", below)];
                dispatch(r, stage, Groups::Direct([self.workgroups, 1, 1]), buffers, &names, push)?;
            }
        }
        Ok(())
    }
}
