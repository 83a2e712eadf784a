//! Grouping of layers into backward passes, and the work of these passes.

use crate::fitting::ledger::{Ledger, StageWork, add};
use crate::model::params::{Layer, NetworkMap};
use crate::network::fused::shape::Backward;
use crate::network::{F16_BYTES, SAMPLE_BYTES};

/// Weights of a layer on one of its inputs; layers count from 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LayerInput {
    /// Weights on the layer below.
    Hidden(usize),
    /// Weights on the encoding.
    Encoded(usize),
}

impl LayerInput {
    pub(super) fn layer(self) -> usize {
        match self {
            LayerInput::Hidden(layer) | LayerInput::Encoded(layer) => layer,
        }
    }
}

/// One backward pass. If it has a lower part, dz of the layer in between stays on the multiprocessor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Span {
    pub(super) upper: LayerInput,
    pub(super) lower: Option<LayerInput>,
}

impl Span {
    /// Returns the part that is processed last.
    pub(super) fn last(self) -> LayerInput {
        self.lower.unwrap_or(self.upper)
    }

    /// Tells whether the pass writes dz of a layer below.
    pub(super) fn with_input(self) -> bool {
        matches!(self.last(), LayerInput::Hidden(_))
    }
}

/// Returns the backward passes in their order, from the last layer down. With `pairs`, a pass takes two layers where possible;
/// pairs are made from the first layer up, so that a single remaining layer is the last one.
pub(super) fn spans(layers: &[Layer], pairs: bool) -> Vec<Span> {
    let parts = |(l, layer): (usize, &Layer)| {
        [layer.hidden.map(|_| LayerInput::Hidden(l)), layer.encoded.map(|_| LayerInput::Encoded(l))]
            .into_iter()
            .flatten()
    };
    let mut parts: Vec<LayerInput> = layers.iter().enumerate().rev().flat_map(parts).collect();
    let mut spans = Vec::new();
    while let Some(last) = parts.pop() {
        let above = parts.last().copied().filter(|above| pairs && joins(layers, *above, last));
        spans.push(match above {
            Some(upper) => Span { upper, lower: Some(last) },
            None => Span { upper: last, lower: None },
        });
        if above.is_some() {
            parts.pop();
        }
    }
    spans.reverse();
    spans
}

/// Tells whether one pass may go through both. A layer that sees both inputs needs its dz twice, hence in memory.
fn joins(layers: &[Layer], upper: LayerInput, lower: LayerInput) -> bool {
    let below = &layers[lower.layer()];
    matches!(upper, LayerInput::Hidden(layer) if layer == lower.layer() + 1)
        && !(below.hidden.is_some() && below.encoded.is_some())
}

/// Tells whether the last pass can recompute the encoding and the first layer: nothing else reads them, and the pass does not
/// begin at the output, whose gradient has buffers of its own.
pub(super) fn recomputes(spans: &[Span]) -> bool {
    let encoded = |part: LayerInput| matches!(part, LayerInput::Encoded(_));
    let readers = spans.iter().flat_map(|span| [Some(span.upper), span.lower]).flatten().filter(|part| encoded(*part));
    spans.len() > 1 && readers.count() == 1 && spans.last().is_some_and(|span| span.lower.is_some_and(encoded))
}

/// Minimum work of the passes, for the given backward sizes and number of columns of weights on the encoding. The forward pass
/// stores what the backward passes read. Each backward pass reads its dz, its inputs and, for masks, the last layer's
/// activations, and writes dz of the layer below.
pub(super) fn work(params: &NetworkMap, encoded: u64, samples: u64, backward: Backward) -> Ledger {
    let Backward { pairs, recompute, .. } = backward;
    let width = params.width as u64;
    let mut ledger = Ledger::new();
    let mut count = |stage: &str, flop: u64, numbers: u64, bytes: u64| {
        add(&mut ledger, stage, StageWork::per_item(samples, flop, numbers * F16_BYTES + bytes));
    };
    let first = 2 * width * params.encoded_len as u64;
    let kept_layers = (params.layers.len() - usize::from(recompute)) as u64;
    let kept_features = if recompute { 0 } else { encoded };
    count("mlp_fused_fwd", 2 * width, kept_features + kept_layers * width, SAMPLE_BYTES);
    let products = |part: LayerInput| match part {
        LayerInput::Hidden(_) => 2 * width * width,
        LayerInput::Encoded(_) => first,
    };
    let spans = spans(&params.layers, pairs);
    for (i, span) in spans.iter().enumerate() {
        let recomputed = recompute && i + 1 == spans.len();
        let read = |part: LayerInput| match part {
            _ if recomputed => 0,
            LayerInput::Hidden(_) => width,
            LayerInput::Encoded(_) => encoded,
        };
        for part in [Some(span.upper), span.lower].into_iter().flatten() {
            count("mlp_fused_fwd", products(part), 0, 0);
            let gradients = if matches!(part, LayerInput::Hidden(_)) { 2 } else { 1 };
            count("mlp_fused_bwd", gradients * products(part), read(part), 0);
        }
        if recomputed {
            count("mlp_fused_bwd", first, 0, SAMPLE_BYTES);
        }
        let written = if span.with_input() { width } else { 0 };
        count("mlp_fused_bwd", 0, width + written, 0);
    }
    // The last layer's dz comes from the output, where the loss is.
    count("mlp_fused_bwd", 4 * width, 0, SAMPLE_BYTES);
    ledger
}
