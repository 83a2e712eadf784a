//! The network on cooperative matrices: f16 operands, f32 sums, f32 master parameters. There is one forward pass; a backward
//! pass goes through up to two layers.
//!
//! A layer that sees the input has one weight matrix on `[encoding, one-hot phase, zeros]`: the columns of the phases hold bias
//! and latent contribution, so that their gradient, summed per phase, is part of the weight gradient.
//!
//! Gradients are multiplied by a loss scale (`state.loss_scale`) before they become f16, and divided by it after the sums. A
//! sum that is not finite skips the update and lowers the scale; enough finite updates in a row double it (`report`).

mod shape;
mod span;

use crate::error::{Error, Result};
use crate::fitting::ledger::Ledger;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::capabilities::MatrixShape;
use crate::gpu::device::Gpu;
use crate::gpu::record::Groups;
use crate::kernels::constants::NOWHERE;
use crate::kernels::dispatch::{Binding, BufferSet, buffer_set};
use crate::kernels::layout::Setup;
use crate::kernels::push;
use crate::kernels::stages::{Build, Stage, matrix_shape, why_no_matrices};
use crate::kernels::tuning::{MatrixTuning, Tuning};
use crate::model::params::NetworkMap;
use crate::network::chunk::Chunk;
use crate::network::fused::shape::Shape;
use crate::network::fused::span::{LayerInput, Span, recomputes, spans, work};
use crate::network::pass::Pass;
use crate::network::{PartialSums, Path, Purpose, Tiles, built_for_rendering};

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
        /// Sources of each packed weight, then of each row of biases.
        pack_source,
    }
}

/// Passes and buffers that only the backward pass needs.
struct FusedTraining {
    passes: Vec<BackwardPass>,
    /// dz at the neurons of one layer, and of the next layer below, which a pass writes.
    dz16: [Buffer; 2],
}

/// One backward pass through the layers of a span.
struct BackwardPass {
    span: Span,
    stage: BackwardStage,
    /// Index of the buffer in `dz16` that the pass reads.
    reads: usize,
    /// Whether this pass is the first to read dz of its upper part's layer; it then computes the sums that depend on dz alone.
    sums_dz: bool,
}

/// Kernel of a backward pass.
enum BackwardStage {
    /// Reads the layers' stored inputs.
    Kept(Stage<push::MlpFusedBwd>),
    /// Goes through the first two layers, and recomputes the encoding and the first layer.
    Recomputed(Stage<push::MlpFusedBwdFirst>),
}

/// Builds the kernels on matrices.
struct Builder<'a> {
    gpu: &'a Gpu,
    shape: &'a Shape,
    params: &'a NetworkMap,
    tuning: &'a MatrixTuning,
}

/// Suffix of a kernel's variant. All variants compute the same results: unrolled or not, with f16 sums or without. Without f16
/// sums there is only one.
fn variant(f16_sums: bool, unroll: bool) -> &'static str {
    match (f16_sums, unroll) {
        (true, true) => "_unrolled",
        (true, false) => "",
        (false, _) => "_f32_sums",
    }
}

impl Builder<'_> {
    fn common(&self, tile: u32, subgroups: u32) -> [(&'static str, u32); 6] {
        let MatrixShape { m, n, k, .. } = self.shape.matrix;
        [("m", m), ("n", n), ("k", k), ("tile", tile), ("subgroups", subgroups), ("width", self.params.width as u32)]
    }

    fn build<'c>(&self, subgroups: u32, unroll: bool, constants: &'c [(&'static str, u32)]) -> Build<'c> {
        let lanes = Some(subgroups * self.gpu.info().matrix_subgroup);
        Build { variant: variant(self.tuning.f16_sums, unroll), lanes, constants, matrices: true, ..Build::default() }
    }

    fn forward(&self, purpose: Purpose) -> Result<Stage<push::MlpFusedFwd>> {
        let layers = &self.params.layers;
        let skip = layers.iter().skip(1).position(|l| l.encoded.is_some()).map_or(0, |i| i + 1);
        let keep_from = if purpose == Purpose::Train { self.shape.first_kept() } else { layers.len() };
        let mut constants = self.common(self.shape.fwd_tile, self.shape.subgroups).to_vec();
        constants.extend([
            ("encoded", self.shape.encoded as u32),
            ("layers", layers.len() as u32),
            ("skip", skip as u32),
            ("keep_features", u32::from(keep_from == 0)),
            ("keep_from", keep_from as u32),
        ]);
        self.build(self.shape.subgroups, self.tuning.unroll_forward, &constants).stage(self.gpu)
    }

    fn columns(&self, part: LayerInput) -> u32 {
        match part {
            LayerInput::Hidden(_) => self.params.width as u32,
            LayerInput::Encoded(_) => self.shape.encoded as u32,
        }
    }

    /// Chooses the number of shares of a weight gradient's columns: the one for which subgroups keep the fewest tiles, and
    /// among these load the fewest operands.
    fn shares(&self, columns: u32) -> u32 {
        let (MatrixShape { m, n, .. }, subgroups) = (self.shape.matrix, self.shape.backward.subgroups);
        let cost = |shares: &u32| {
            let rows = (self.params.width as u32 / m).div_ceil(subgroups / shares);
            let columns = (columns / n).div_ceil(*shares);
            (rows * columns, rows + columns)
        };
        [1, 2, 4].into_iter().filter(|shares| subgroups.is_multiple_of(*shares)).min_by_key(cost).unwrap_or(1)
    }

    fn backward(&self, span: Span) -> Result<BackwardStage> {
        let sizes = self.shape.backward;
        let columns = self.columns(span.upper);
        let lower_columns = span.lower.map_or(0, |part| self.columns(part));
        let lower_shares = if lower_columns > 0 { self.shares(lower_columns) } else { 1 };
        let mut constants = self.common(sizes.tile, sizes.subgroups).to_vec();
        constants.extend([
            ("lower_columns", lower_columns),
            ("shares", self.shares(columns)),
            ("lower_shares", lower_shares),
        ]);
        if sizes.recompute && span.last() == LayerInput::Encoded(0) {
            return Ok(BackwardStage::Recomputed(
                self.build(sizes.subgroups, self.tuning.unroll_backward, &constants).stage(self.gpu)?,
            ));
        }
        let from_output = span.upper.layer() + 1 == self.params.layers.len();
        constants.extend([
            ("upper_columns", columns),
            ("with_input", u32::from(span.with_input())),
            ("from_output", u32::from(from_output)),
        ]);
        Ok(BackwardStage::Kept(self.build(sizes.subgroups, self.tuning.unroll_backward, &constants).stage(self.gpu)?))
    }

    /// Builds the backward passes, from the last layer down.
    fn passes(&self) -> Result<Vec<BackwardPass>> {
        let mut built: Vec<BackwardPass> = Vec::new();
        let mut reads = vec![0; self.params.layers.len()];
        for span in spans(&self.params.layers, self.shape.backward.pairs) {
            let layer = span.upper.layer();
            if span.with_input() {
                reads[span.last().layer() - 1] = 1 - reads[layer];
            }
            let sums_dz = built.iter().all(|pass| pass.span.upper.layer() != layer);
            built.push(BackwardPass { span, stage: self.backward(span)?, reads: reads[layer], sums_dz });
        }
        Ok(built)
    }
}

/// Tells whether the backward passes recompute the encoding and the first layer of such a network.
pub fn computes_again(tuning: &MatrixTuning, params: &NetworkMap) -> bool {
    tuning.recompute && recomputes(&spans(&params.layers, tuning.pairs))
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
        let matrix = matrix_shape(info).ok_or_else(|| {
            let problem = format!("{}: {}; choose f32 or auto", info.name, why_no_matrices());
            Error::config("layers", "matrices", problem)
        })?;
        let shape = Shape::new(info, matrix, &tuning.matrices, params)?;
        let builder = Builder { gpu, shape: &shape, params, tuning: &tuning.matrices };
        let (width, encoded) = (params.width, shape.encoded);
        let capacity = u64::from(setup.sample_capacity);
        let training = match purpose {
            Purpose::Render => None,
            Purpose::Train => Some(FusedTraining {
                passes: builder.passes()?,
                dz16: [
                    gpu.buffer("dz16_a", capacity * width as u64 * 2, Memory::Device)?,
                    gpu.buffer("dz16_b", capacity * width as u64 * 2, Memory::Device)?,
                ],
            }),
        };
        let kept = |per_sample: usize| match per_sample {
            0 => 16,
            _ if training.is_none() => 16,
            _ => capacity * per_sample as u64 * 2,
        };
        let first_kept = shape.first_kept();
        let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
        let bias_len = params.layers.len() * matrix.m as usize * width;
        let buffers = FusedBuffers {
            weights16: new(Binding::weights16, shape.weights_len as u64 * 2)?,
            bias_rows: new(Binding::bias_rows, bias_len as u64 * 4)?,
            features16: new(Binding::features16, kept(if first_kept == 0 { encoded } else { 0 }))?,
            activations16: new(Binding::activations16, kept((params.layers.len() - first_kept) * width))?,
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

    /// Position at which the stored activations of a layer begin, in `uvec4`s.
    fn activations_at(&self, map: &NetworkMap, layer: usize, pass: &Pass<'_>) -> u32 {
        let layer = (layer - self.shape.first_kept()) as u32;
        layer * pass.setup.sample_capacity * map.width as u32 / 8
    }

    /// Returns the buffer of a part's inputs, and their position in it.
    fn inputs(&self, map: &NetworkMap, part: LayerInput, pass: &Pass<'_>) -> (&Buffer, u32) {
        match part {
            LayerInput::Hidden(layer) => (&self.buffers.activations16, self.activations_at(map, layer - 1, pass)),
            LayerInput::Encoded(_) => (&self.buffers.features16, 0),
        }
    }

    /// Records one backward pass.
    fn record_pass(&self, map: &NetworkMap, pass: &mut Pass<'_>, backward: &BackwardPass, chunk: Chunk) -> Result<()> {
        let (shape, dz16, groups) = (&self.shape, &self.training()?.dz16, Groups::Direct([self.workgroups, 1, 1]));
        let BackwardPass { span, stage, reads, sums_dz } = backward;
        let position = |at: Option<usize>| at.map_or(NOWHERE, |at| at as u32);
        let bias = |part: LayerInput| position(shape.layers[part.layer()].bias);
        let (weights_at, n_partials) = (position(shape.weights_of(span.upper)), shape.partials_len as u32);
        let lower_weights_at = position(span.lower.and_then(|part| shape.weights_of(part)));
        let upper_bias = if *sums_dz { bias(span.upper) } else { NOWHERE };
        let lower_bias = span.lower.map_or(NOWHERE, bias);
        let accumulate = chunk.accumulate();
        let dz = (Binding::dz16, (&dz16[*reads]).into());
        let stage = match stage {
            BackwardStage::Kept(stage) => stage,
            BackwardStage::Recomputed(stage) => {
                let push = push::MlpFusedBwdFirst {
                    weights_at,
                    lower_weights_at,
                    n_partials,
                    bias: upper_bias,
                    lower_bias,
                    accumulate,
                };
                return pass.run_with(stage, groups, &[dz], push);
            }
        };
        let layer = span.upper.layer();
        let sums_outputs = layer + 1 == shape.layers.len() && *sums_dz;
        let (inputs, inputs_at) = self.inputs(map, span.upper, pass);
        let (lower_inputs, lower_inputs_at) = span.lower.map_or((inputs, 0), |part| self.inputs(map, part, pass));
        let push = push::MlpFusedBwd {
            weights_at,
            lower_weights_at,
            inputs_at,
            lower_inputs_at,
            outputs_at: self.activations_at(map, layer, pass),
            out_weights_at: shape.out_weights as u32,
            n_partials,
            bias: upper_bias,
            lower_bias,
            out_weights: position(sums_outputs.then_some(shape.out_weights)),
            out_bias: position(sums_outputs.then_some(shape.out_bias)),
            accumulate,
        };
        let bound = [
            (Binding::inputs16, inputs.into()),
            (Binding::lower_inputs16, lower_inputs.into()),
            (Binding::outputs16, (&self.buffers.activations16).into()),
            dz,
            (Binding::dz_in16, (&dz16[1 - *reads]).into()),
        ];
        pass.run_with(stage, groups, &bound, push)
    }
}

impl Path for FusedNetwork {
    fn work(&self, params: &NetworkMap, samples: u64) -> Ledger {
        work(params, self.shape.encoded as u64, samples, self.shape.backward)
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

    /// Records `mlp_pack`, which writes f16 copies of the weights, with bias and latent contribution of each phase among them.
    fn record_weights(&self, map: &NetworkMap, pass: &mut Pass<'_>) -> Result<()> {
        let n_pairs = (self.shape.weights_len / 2) as u32;
        let params = map;
        let n_bias = params.layers.len() as u32 * self.shape.matrix.m * params.width as u32;
        let push = push::MlpPack { n_pairs, n_bias, latents: params.latents as u32 };
        pass.run(&self.mlp_pack, self.mlp_pack.groups_for(n_pairs + n_bias), push)
    }

    fn record_forward(&self, map: &NetworkMap, pass: &mut Pass<'_>) -> Result<()> {
        let push = push::MlpFusedFwd { out_bias: map.out_bias as u32 };
        pass.run(&self.mlp_fused_fwd, pass.buffers.forward_tiles(), push)
    }

    fn record_backward(&self, map: &NetworkMap, pass: &mut Pass<'_>, chunk: Chunk) -> Result<()> {
        self.training()?.passes.iter().try_for_each(|backward| self.record_pass(map, pass, backward, chunk))
    }

    /// Returns their positions in the partial sums, which contain them.
    fn phase_source(&self, params: &NetworkMap) -> Vec<u32> {
        self.shape.phase_source(params)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::sections::NertCaSettings;
    use crate::config::{Config, Preset};
    use crate::model::params::ParamMap;
    use crate::network::SAMPLE_BYTES;
    use crate::network::cost::NetworkCost;
    use crate::network::fused::shape::Backward;

    #[test]
    fn the_papers_network_moves_two_kilobytes_a_sample() {
        let params = ParamMap::new(&Config::preset(Preset::Paper), 10);
        let cost = NetworkCost::of(&params);
        // The weights on the input have 63 numbers and 10 phases, padded to 80 columns.
        let ledger = |pairs, recompute| {
            let backward = Backward { subgroups: 8, tile: 64, pairs, recompute };
            let ledger = work(params.dynamic_network.as_ref().unwrap(), 80, 1_000_000_000, backward);
            ["mlp_fused_fwd", "mlp_fused_bwd"].map(|stage| ledger[stage])
        };
        let [forward, backward] = ledger(true, false);
        assert_eq!(forward.gflop as u64, cost.forward);
        assert_eq!(backward.gflop as u64, cost.weights + cost.inputs);
        // The stored values have two bytes each: 80 columns and 4 x 128 activations forward; 4 x 128 numbers of the upper two
        // layers and 2 x 128 + 80 of the others backward.
        assert_eq!(forward.megabytes as u64, 1_000 * (160 + 4 * 256 + SAMPLE_BYTES));
        assert_eq!(backward.megabytes as u64, 1_000 * (4 * 256 + 2 * 256 + 160 + SAMPLE_BYTES));
        let [forward, backward] = ledger(true, true);
        assert_eq!(backward.gflop as u64, cost.weights + cost.inputs + 2 * 63 * 128);
        assert_eq!(forward.megabytes as u64, 1_000 * (3 * 256 + SAMPLE_BYTES));
        assert_eq!(backward.megabytes as u64, 1_000 * (4 * 256 + 256 + 2 * SAMPLE_BYTES));
        // Without pairs, each of three layers moves its inputs, its dz and dz of the layer below; the first layer has no dz
        // below.
        let [_, backward] = ledger(false, false);
        assert_eq!(backward.gflop as u64, cost.weights + cost.inputs);
        assert_eq!(backward.megabytes as u64, 1_000 * (3 * 768 + 416 + SAMPLE_BYTES));
    }

    #[test]
    fn layers_are_paired_from_the_first_up() {
        let spans_of = |layers: usize, skip_layer: usize, pairs: bool| {
            let mut config = Config::preset(Preset::Paper).of::<NertCaSettings>().unwrap();
            (config.network.layers, config.network.skip_layer) = (layers as u32, skip_layer as u32);
            let spans = spans(&ParamMap::new(&config.into_any(), 10).dynamic_network.unwrap().layers, pairs);
            spans.iter().map(|span| (span.upper, span.lower)).collect::<Vec<_>>()
        };
        use LayerInput::{Encoded, Hidden};
        assert_eq!(spans_of(4, 0, true), [(Hidden(3), Some(Hidden(2))), (Hidden(1), Some(Encoded(0)))]);
        assert_eq!(spans_of(3, 0, true), [(Hidden(2), None), (Hidden(1), Some(Encoded(0)))]);
        assert_eq!(spans_of(1, 0, true), [(Encoded(0), None)]);
        // A layer that sees both inputs has its dz in memory.
        let skips = spans_of(4, 3, true);
        assert_eq!(skips, [(Hidden(3), None), (Hidden(2), None), (Encoded(2), None), (Hidden(1), Some(Encoded(0)))]);
        assert_eq!(spans_of(3, 0, false), [(Hidden(2), None), (Hidden(1), None), (Encoded(0), None)]);
    }
}
