//! Sizes of the matrix passes, and positions of the packed weights and of their gradients.

use crate::error::{Error, Result};
use crate::gpu::capabilities::{DeviceInfo, MatrixShape};
use crate::kernels::constants::{NOWHERE, PHASE_BIAS};
use crate::kernels::tuning::MatrixTuning;
use crate::model::params::NetworkMap;
use crate::network::fused::computes_again;
use crate::network::fused::span::LayerInput;

/// Shared memory reserved for everything but the tiles, bytes.
const SHARED_RESERVE: u32 = 512;

/// Positions of one hidden layer in the packed weights, which are also those of its gradient in the partial sums.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct PackedLayer {
    /// Weights on the encoding, `[width][encoded]`.
    pub(super) encoded: Option<usize>,
    /// Weights on the layer below, `[width][width]`.
    pub(super) hidden: Option<usize>,
    /// Bias, `[width]`; in the partial sums only.
    pub(super) bias: Option<usize>,
}

/// Number of bytes of a row of `numbers` values in shared memory. One more `uvec4` per row avoids bank conflicts
/// between rows.
fn row_bytes(numbers: u32) -> u32 {
    16 * (numbers / 8 + 1)
}

/// Constraints on tiles of samples: multiples of `m` and `k`, and at most `bytes` of shared memory.
struct Room {
    m: u32,
    k: u32,
    bytes: u32,
}

impl Room {
    /// Returns the number of samples of the largest tile that fits into the bytes available.
    fn tile(&self, largest: u32, bytes: impl Fn(u32) -> u32) -> Option<u32> {
        let tiles = [128, 64, 32, 16].into_iter();
        let mut tiles = tiles.filter(|t| *t <= largest && t.is_multiple_of(self.m) && t.is_multiple_of(self.k));
        tiles.find(|t| bytes(*t) <= self.bytes)
    }
}

/// Sizes of the backward passes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Backward {
    /// Subgroups of a workgroup.
    pub(super) subgroups: u32,
    /// Samples of a tile.
    pub(super) tile: u32,
    /// Whether a pass goes through two layers at once where possible.
    pub(super) pairs: bool,
    /// Whether the encoding and the first layer's activations are recomputed instead of read.
    pub(super) recompute: bool,
}

/// Largest backward tile: more samples would lengthen a workgroup's wait at its barriers.
const LARGEST_BACKWARD_TILE: u32 = 64;

/// Sizes and positions, derived from the network's shape and the device's limits.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Shape {
    pub(super) matrix: MatrixShape,
    /// Subgroups of a forward workgroup.
    pub(super) subgroups: u32,
    /// Samples of a forward tile.
    pub(super) fwd_tile: u32,
    /// Sizes of the backward passes.
    pub(super) backward: Backward,
    /// Columns of the weights on the encoding: encoded numbers, phases, padding.
    pub(super) encoded: usize,
    pub(super) layers: Vec<PackedLayer>,
    /// Position of the output weights: `n` rows of `[width]` in the packed weights, of which only the first is in the
    /// partial sums.
    pub(super) out_weights: usize,
    pub(super) weights_len: usize,
    /// Position of the output bias in the partial sums.
    pub(super) out_bias: usize,
    pub(super) partials_len: usize,
}

impl Shape {
    /// # Errors
    /// [`Error::Config`] when the network does not fit the device's shared memory or workgroups.
    pub(super) fn new(
        info: &DeviceInfo,
        matrix: MatrixShape,
        tuning: &MatrixTuning,
        params: &NetworkMap,
    ) -> Result<Shape> {
        let MatrixShape { m, n, k, .. } = matrix;
        let width = params.width as u32;
        let encoded = (params.encoded_len + params.phases).next_multiple_of(16);
        let unfit = |what: String| Error::config("dynamic.width", width, what);
        let max = (info.max_workgroup_invocations / info.matrix_subgroup).min(info.max_workgroup_subgroups);
        let subgroups = (1..=max.min(8)).rev().find(|s| (width / n).is_multiple_of(*s)).unwrap_or(1);
        if subgroups * info.matrix_subgroup < width / 8 {
            return Err(unfit("is too wide for the matrix kernels on this device".into()));
        }
        // Without f16 sums, each subgroup has a tile of sums in addition to the tiles of samples.
        let room = |subgroups: u32| {
            let sums = if tuning.f16_sums { 0 } else { subgroups * m * n * 4 };
            Room { m, k, bytes: info.max_shared_memory.saturating_sub(SHARED_RESERVE + sums) }
        };
        // The output's n sums are stored in a row of the last layer's activations.
        let (hidden_row, encoded_row) = (row_bytes(width).max(4 * n), row_bytes(encoded as u32));
        let skips = params.layers.iter().skip(1).any(|l| l.encoded.is_some());
        let rows = if skips { hidden_row + encoded_row } else { hidden_row.max(encoded_row) };
        let fwd_tile = room(subgroups).tile(tuning.largest_tile, |t| t * rows);
        let recompute = computes_again(tuning, params);
        let inputs_row = if recompute { hidden_row + encoded_row } else { hidden_row.max(encoded_row) };
        let backward = |subgroups: u32| {
            let scratch = 2 * 16 * subgroups * info.matrix_subgroup;
            let bytes = |t: u32| (t * hidden_row).max(scratch) + t * (inputs_row + 4);
            let tile = room(subgroups).tile(tuning.largest_tile.min(LARGEST_BACKWARD_TILE), bytes)?;
            Some(Backward { subgroups, tile, pairs: tuning.pairs, recompute })
        };
        // If there are more subgroups than tiles across a layer, they share the rows of its input gradient.
        let sums = if tuning.pairs { 2 } else { 1 } * width * width;
        let few_sums = |b: &Backward| sums <= tuning.backward_sums * b.subgroups * info.matrix_subgroup;
        let fits = |b: &Backward| {
            let columns = width / n;
            let row_shares = b.subgroups / columns.min(b.subgroups);
            b.subgroups <= max
                && b.subgroups * info.matrix_subgroup <= tuning.backward_lanes.max(subgroups * info.matrix_subgroup)
                && (b.subgroups <= columns || b.subgroups.is_multiple_of(columns))
                && (b.tile / m).is_multiple_of(row_shares)
        };
        let backwards: Vec<Backward> =
            [1, 2, 4].iter().filter_map(|times| backward(times * subgroups)).take_while(fits).collect();
        let backward = backwards.iter().find(|b| few_sums(b)).or(backwards.last());
        let (Some(fwd_tile), Some(&backward)) = (fwd_tile, backward) else {
            return Err(unfit(format!(
                "needs more than the {} KiB of shared memory of this device",
                info.max_shared_memory >> 10
            )));
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
            backward,
            encoded,
            layers,
            out_weights,
            weights_len,
            out_bias,
            partials_len,
        })
    }

    /// Returns the first layer whose activations the forward pass keeps.
    pub(super) fn first_kept(&self) -> usize {
        usize::from(self.backward.recompute)
    }

    /// Position of a part's weights, both packed and in the partial sums.
    pub(super) fn weights_of(&self, part: LayerInput) -> Option<usize> {
        match part {
            LayerInput::Hidden(layer) => self.layers[layer].hidden,
            LayerInput::Encoded(layer) => self.layers[layer].encoded,
        }
    }

    /// Returns the source of each packed weight, then of each row of biases.
    pub(super) fn pack_source(&self, params: &NetworkMap) -> Vec<u32> {
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
                    // Without latents, the bias is the same at all phases.
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

    /// Returns the position of the gradient of each network parameter in the partial sums.
    pub(super) fn gradient_source(&self, params: &NetworkMap) -> Vec<u32> {
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

    /// Returns the positions in the partial sums of the sums of dz over each phase, `[layer][phase][neuron]`.
    pub(super) fn phase_source(&self, params: &NetworkMap) -> Vec<u32> {
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
