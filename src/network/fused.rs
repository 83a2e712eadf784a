//! The network on cooperative matrices: f16 operands, f32 sums, f32 master parameters. One pass forward, one or two
//! per layer backward.
//!
//! A layer that sees the input has one weight matrix on `[encoding, one-hot phase, zeros]`: the columns of the phases
//! hold bias and latent contribution, so that their gradient, summed per phase, is part of the weight gradient.
//!
//! Gradients are multiplied by a loss scale (`state.loss_scale`) before they become f16 and divided by it after the sums.
//! A sum that is not finite skips the update and halves the scale; many good ones double it (`report`).

use crate::error::{Error, Result};
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::capabilities::{DeviceInfo, MatrixShape};
use crate::gpu::device::Gpu;
use crate::gpu::record::Groups;
use crate::kernels::constants::{NOWHERE, PHASE_BIAS};
use crate::kernels::dispatch::{Binding, BufferSet, buffer_set};
use crate::kernels::layout::Setup;
use crate::kernels::push;
use crate::kernels::stages::{Build, Stage};
use crate::kernels::tuning::Tuning;
use crate::model::params::NetworkMap;
use crate::network::chunk::Chunk;
use crate::network::ledger::{Ledger, StageWork, add};
use crate::network::pass::Pass;
use crate::network::{
    F16_BYTES, GradientBuffers, PartialSums, Path, Purpose, SAMPLE_BYTES, Tiles, built_for_rendering,
};

/// Shared memory beside the tiles, bytes.
const SHARED_RESERVE: u32 = 512;

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
    fn new(info: &DeviceInfo, matrix: MatrixShape, largest: u32, params: &NetworkMap) -> Result<Shape> {
        let MatrixShape { m, n, k } = matrix;
        let width = params.width as u32;
        let encoded = (params.encoded_len + params.phases).next_multiple_of(16);
        let unfit = |what: String| Error::config("dynamic.width", width, what);
        let most = (info.max_workgroup_invocations / info.matrix_subgroup).min(info.max_workgroup_subgroups).min(8);
        let subgroups = (1..=most).rev().find(|s| (width / n).is_multiple_of(*s)).unwrap_or(1);
        if subgroups * info.matrix_subgroup < width / 8 {
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
        let scratch = 2 * 16 * subgroups * info.matrix_subgroup;
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
    fn pack_source(&self, params: &NetworkMap) -> Vec<u32> {
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
                    // Without latents a bias is a bias, the same at all phases.
                    let columns = if layer.latent.is_some() { params.phases } else { 0 };
                    for (phase, s) in row[params.encoded_len..][..columns].iter_mut().enumerate() {
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
    fn gradient_source(&self, params: &NetworkMap) -> Vec<u32> {
        let mut source = vec![NOWHERE; params.len];
        let width = params.width;
        let mut put = |at: usize, from: usize| source[at - params.first] = from as u32;
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
    fn phase_source(&self, params: &NetworkMap) -> Vec<u32> {
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

/// Kernels and buffers of the fused network.
pub(super) struct FusedNetwork {
    shape: Shape,
    /// Workgroups of the backward passes, each with its own partial sums.
    workgroups: u32,
    mlp_pack: Stage<push::MlpPack>,
    mlp_fused_fwd: Stage<push::MlpFusedFwd>,
    buffers: FusedBuffers,
    training: Option<FusedTraining>,
}

buffer_set! {
    /// Buffers of the forward pass.
    struct FusedBuffers {
        /// f16 copies of the weights.
        weights16,
        /// Biases, repeated over the rows of a product.
        bias_rows,
        /// Encodings, kept for the backward pass.
        features16,
        /// Activations of all layers, kept for the backward pass.
        activations16,
        /// Where each packed weight, then each row of biases, comes from.
        pack_source,
    }
}

/// What the backward pass needs besides.
struct FusedTraining {
    kernels: BackwardKernels,
    /// Gradients at the neurons of even and odd layers.
    dz16: [Buffer; 2],
    /// Where the sum of dz over each phase lies in the partial sums.
    phase_source: Buffer,
}

struct BackwardKernels {
    /// Through the last hidden layer, whose dz it forms.
    last: Stage<push::MlpFusedBwd>,
    /// Through the others.
    hidden: Stage<push::MlpFusedBwd>,
    /// Weights on the encoding.
    encoded: Stage<push::MlpFusedBwd>,
    /// Weights of the last hidden layer on the encoding.
    last_encoded: Stage<push::MlpFusedBwd>,
}

/// Builds the passes on matrices.
struct Builder<'a> {
    gpu: &'a Gpu,
    shape: &'a Shape,
    params: &'a NetworkMap,
    build: Build<'a>,
}

impl Builder<'_> {
    fn new<'a>(gpu: &'a Gpu, tuning: &Tuning, shape: &'a Shape, params: &'a NetworkMap) -> Builder<'a> {
        let build = Build {
            // Unrolled or not, they compute the same.
            variant: if tuning.matrices.unroll { "_unrolled" } else { "" },
            lanes: Some(shape.subgroups * gpu.info().matrix_subgroup),
            matrices: true,
            ..Build::default()
        };
        Builder { gpu, shape, params, build }
    }

    fn common(&self, tile: u32) -> [(&'static str, u32); 6] {
        let MatrixShape { m, n, k } = self.shape.matrix;
        let (subgroups, width) = (self.shape.subgroups, self.params.width as u32);
        [("m", m), ("n", n), ("k", k), ("tile", tile), ("subgroups", subgroups), ("width", width)]
    }

    fn forward(&self, purpose: Purpose) -> Result<Stage<push::MlpFusedFwd>> {
        let layers = &self.params.layers;
        let skip = layers.iter().skip(1).position(|l| l.encoded.is_some()).map_or(0, |i| i + 1);
        let mut constants = self.common(self.shape.fwd_tile).to_vec();
        constants.extend([
            ("encoded", self.shape.encoded as u32),
            ("layers", layers.len() as u32),
            ("skip", skip as u32),
            ("keep", u32::from(purpose == Purpose::Train)),
        ]);
        Build { constants: &constants, ..self.build }.stage(self.gpu)
    }

    fn backward(&self, columns: usize, with_input: bool, from_output: bool) -> Result<Stage<push::MlpFusedBwd>> {
        let column_tiles = columns as u32 / self.shape.matrix.n;
        let halves = if self.shape.subgroups.is_multiple_of(2) && column_tiles.is_multiple_of(2) { 2 } else { 1 };
        let mut constants = self.common(self.shape.bwd_tile).to_vec();
        constants.extend([
            ("columns", columns as u32),
            ("with_input", u32::from(with_input)),
            ("from_output", u32::from(from_output)),
            ("halves", halves),
        ]);
        Build { constants: &constants, ..self.build }.stage(self.gpu)
    }
}

impl FusedNetwork {
    /// # Errors
    /// [`Error::Config`] when device and network do not fit; errors of [`Gpu::matrix_pipeline`].
    pub(super) fn new(
        gpu: &Gpu,
        tuning: &Tuning,
        setup: &Setup,
        params: &NetworkMap,
        purpose: Purpose,
    ) -> Result<FusedNetwork> {
        let info = gpu.info();
        let matrix = *info.matrices.first().ok_or_else(|| {
            let problem = "this device has no cooperative matrices our kernels can use: take f32 or auto";
            Error::config("layers", "matrices", format!("{}: {problem}", info.name))
        })?;
        let shape = Shape::new(info, matrix, tuning.matrices.largest_tile, params)?;
        let builder = Builder::new(gpu, tuning, &shape, params);
        let (width, encoded) = (params.width, shape.encoded);
        let capacity = u64::from(setup.sample_capacity);
        let training = match purpose {
            Purpose::Render => None,
            Purpose::Train => Some(FusedTraining {
                kernels: BackwardKernels {
                    last: builder.backward(width, true, true)?,
                    hidden: builder.backward(width, true, false)?,
                    encoded: builder.backward(encoded, false, false)?,
                    last_encoded: builder.backward(encoded, false, true)?,
                },
                dz16: [
                    gpu.buffer("dz16_even", capacity * width as u64 * 2, Memory::Device)?,
                    gpu.buffer("dz16_odd", capacity * width as u64 * 2, Memory::Device)?,
                ],
                phase_source: gpu.buffer_with("phase_source", &shape.phase_source(params))?,
            }),
        };
        let kept = |per_sample: usize| if training.is_some() { capacity * per_sample as u64 * 2 } else { 16 };
        let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
        let bias_len = params.layers.len() * matrix.m as usize * width;
        let buffers = FusedBuffers {
            weights16: new(Binding::weights16, shape.weights_len as u64 * 2)?,
            bias_rows: new(Binding::bias_rows, bias_len as u64 * 4)?,
            features16: new(Binding::features16, kept(encoded))?,
            activations16: new(Binding::activations16, kept(params.layers.len() * width))?,
            pack_source: gpu.buffer_with("pack_source", &shape.pack_source(params))?,
        };
        Ok(FusedNetwork {
            workgroups: tuning.matrices.workgroups,
            mlp_pack: Build::default().stage(gpu)?,
            mlp_fused_fwd: builder.forward(purpose)?,
            buffers,
            training,
            shape,
        })
    }

    fn training(&self) -> Result<&FusedTraining> {
        self.training.as_ref().ok_or_else(built_for_rendering)
    }

    /// Records one or two passes through layer `l`: over the layer below, and over the encoding if it sees that.
    fn record_layer_backward(&self, pass: &mut Pass<'_>, l: usize, chunk: Chunk) -> Result<()> {
        let (shape, training, params) = (&self.shape, self.training()?, pass.network.map());
        let (k, packed) = (&training.kernels, &self.shape.layers[l]);
        let is_last = l + 1 == params.layers.len();
        let capacity = pass.setup.sample_capacity;
        let activations_at = |l: usize| l as u32 * capacity * params.width as u32 / 8;
        let (on_hidden, on_encoded) = if is_last { (&k.last, &k.last_encoded) } else { (&k.hidden, &k.encoded) };
        let parts = [
            (packed.hidden, &self.buffers.activations16, l.checked_sub(1).map_or(0, activations_at), on_hidden),
            (packed.encoded, &self.buffers.features16, 0, on_encoded),
        ];
        let position = |at: Option<usize>| at.map_or(NOWHERE, |at| at as u32);
        let mut bias = packed.bias;
        let mut out = is_last.then_some((shape.out_weights, shape.out_bias));
        let outputs_at = activations_at(l);
        for (at, input, inputs_at, stage) in parts {
            let Some(at) = at else { continue };
            // The first pass over a layer's dz also sums what depends on dz alone.
            let (out_weights, out_bias) = out.take().unzip();
            let push = push::MlpFusedBwd {
                weights_at: at as u32,
                inputs_at,
                outputs_at,
                out_weights_at: shape.out_weights as u32,
                n_partials: shape.partials_len as u32,
                weights: at as u32,
                bias: position(bias.take()),
                out_weights: position(out_weights),
                out_bias: position(out_bias),
                accumulate: chunk.accumulate(),
            };
            let bound = [
                (Binding::inputs16, input.into()),
                (Binding::outputs16, (&self.buffers.activations16).into()),
                (Binding::dz16, (&training.dz16[l % 2]).into()),
                (Binding::dz_in16, (&training.dz16[(l + 1) % 2]).into()),
            ];
            pass.run_with(stage, Groups::Direct([self.workgroups, 1, 1]), &bound, push)?;
        }
        Ok(())
    }
}

/// Least work of the passes, with so many columns of weights on the encoding. Forward, encoding and activations are kept;
/// backward, each pass reads its layer's dz and input, and leaves the dz of the layer below.
fn work(params: &NetworkMap, encoded: u64, samples: u64) -> Ledger {
    let width = params.width as u64;
    let mut ledger = Ledger::new();
    let mut count = |stage: &str, flop: u64, numbers: u64, bytes: u64| {
        add(&mut ledger, stage, StageWork::per_item(samples, flop, numbers * F16_BYTES + bytes));
    };
    count("mlp_fused_fwd", 2 * width, encoded, SAMPLE_BYTES);
    for (l, layer) in params.layers.iter().enumerate() {
        count("mlp_fused_fwd", 0, width, 0);
        if layer.encoded.is_some() {
            count("mlp_fused_fwd", 2 * width * params.encoded_len as u64, 0, 0);
            count("mlp_fused_bwd", 2 * width * params.encoded_len as u64, width + encoded, 0);
        }
        if layer.hidden.is_some() {
            count("mlp_fused_fwd", 2 * width * width, 0, 0);
            count("mlp_fused_bwd", 4 * width * width, 3 * width, 0);
        }
        if l + 1 == params.layers.len() {
            // The last dz comes from the output, where the loss is.
            count("mlp_fused_bwd", 4 * width, 0, SAMPLE_BYTES);
        }
    }
    ledger
}

impl Path for FusedNetwork {
    fn work(&self, params: &NetworkMap, samples: u64) -> Ledger {
        work(params, self.shape.encoded as u64, samples)
    }

    fn find(&self, name: Binding) -> Option<&Buffer> {
        self.buffers.find(name)
    }

    fn tiles(&self, _: &NetworkMap) -> Tiles {
        Tiles { samples: self.shape.fwd_tile, forward: 1, backward: 1 }
    }

    fn partial_sums(&self, _: &NetworkMap) -> PartialSums {
        PartialSums { splits: self.workgroups, len: self.shape.partials_len as u32 }
    }

    fn gradient_source(&self, params: &NetworkMap) -> Vec<u32> {
        self.shape.gradient_source(params)
    }

    /// f16 copies of the weights.
    fn record_weights(&self, pass: &mut Pass<'_>) -> Result<()> {
        let n_pairs = (self.shape.weights_len / 2) as u32;
        let n_bias = pass.network.map().layers.len() as u32 * self.shape.matrix.m * pass.network.map().width as u32;
        pass.run(&self.mlp_pack, self.mlp_pack.groups_for(n_pairs + n_bias), push::MlpPack { n_pairs, n_bias })
    }

    fn record_forward(&self, pass: &mut Pass<'_>) -> Result<()> {
        let push = push::MlpFusedFwd { out_bias: pass.network.map().out_bias as u32 };
        pass.run(&self.mlp_fused_fwd, pass.buffers.forward_tiles(), push)
    }

    fn record_backward(&self, pass: &mut Pass<'_>, chunk: Chunk) -> Result<()> {
        (0..pass.network.map().layers.len()).rev().try_for_each(|l| self.record_layer_backward(pass, l, chunk))
    }

    /// They are part of the partial sums.
    fn record_phase_sums(&self, pass: &mut Pass<'_>, gradient: &GradientBuffers) -> Result<()> {
        let (stage, params, training) = (&pass.kernels.gradient_network, pass.network.map(), self.training()?);
        let count = (params.layers.len() * params.phases * params.width) as u32;
        let PartialSums { splits, len: n_partials } = self.partial_sums(params);
        let bound =
            [(Binding::source, (&training.phase_source).into()), (Binding::gradient, (&gradient.phase_dz).into())];
        pass.run_with(
            stage,
            stage.groups_for(count),
            &bound,
            push::GradientNetwork { first: 0, count, splits, n_partials },
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Preset};
    use crate::model::params::ParamMap;
    use crate::network::cost::NetworkCost;

    #[test]
    fn the_papers_network_moves_four_kilobytes_a_sample() {
        let params = ParamMap::new(&Config::preset(Preset::Paper), 10);
        // 63 numbers and 10 phases, filled up to 80 columns.
        let (ledger, cost) = (work(&params.moving, 80, 1_000_000_000), NetworkCost::of(&params));
        let [forward, backward] = ["mlp_fused_fwd", "mlp_fused_bwd"].map(|stage| ledger[stage]);
        assert_eq!(forward.gflop as u64, cost.forward);
        assert_eq!(backward.gflop as u64, cost.weights + cost.inputs);
        // Two bytes of 80 columns and 4 x 128 activations; three passes of 3 x 128 numbers and one of 128 + 80.
        assert_eq!(forward.megabytes as u64, 1_000 * (160 + 4 * 256 + SAMPLE_BYTES));
        assert_eq!(backward.megabytes as u64, 1_000 * (3 * 768 + 256 + 160 + SAMPLE_BYTES));
    }
}
