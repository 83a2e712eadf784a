//! The network in f32, one pass per layer: runs on every device, and is the reference for [`super::fused`].

use crate::error::Result;
use crate::fitting::ledger::{Ledger, StageWork, add};
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::record::Groups;
use crate::kernels::constants::NOWHERE;
use crate::kernels::dispatch::{Binding, BufferSet, buffer_set};
use crate::kernels::layout::{SampleTime, Setup};
use crate::kernels::push;
use crate::kernels::stages::LayerKernels;
use crate::kernels::tuning::Tuning;
use crate::model::params::{Layer, NetworkMap};
use crate::network::chunk::{Chunk, chunk_rays};
use crate::network::pass::Pass;
use crate::network::{F32_BYTES, PartialSums, Path, Purpose, SAMPLE_BYTES, Tiles, built_for_rendering};

/// Kernels and buffers of the f32 network.
pub(super) struct LayerNetwork {
    kernels: LayerKernels,
    buffers: LayerBuffers,
    /// Output of each hidden layer.
    activations: Vec<Buffer>,
    training: Option<LayerTraining>,
}

buffer_set! {
    /// Buffers of the forward pass.
    struct LayerBuffers {
        /// Times at which the ray of each live sample was taken.
        sample_times,
        /// Encoding of each live sample.
        features,
        /// Bias and latents of each phase, `[layer][phase][neuron]`.
        phase_bias,
    }
}

/// Buffers that only the backward pass needs.
struct LayerTraining {
    sums: LayerSums,
    /// Gradients at the neurons of even and odd layers.
    dz: [Buffer; 2],
}

buffer_set! {
    /// Gradients per sample and per ray.
    struct LayerSums {
        /// Gradient at the output neuron.
        sample_feature_gradient,
        /// Sums of dz over each ray's samples.
        ray_dz,
    }
}

impl LayerNetwork {
    pub(super) fn new(
        gpu: &Gpu,
        tuning: &Tuning,
        setup: &Setup,
        params: &NetworkMap,
        purpose: Purpose,
    ) -> Result<LayerNetwork> {
        let capacity = u64::from(setup.sample_capacity);
        let rows = (params.layers.len() * params.phases * params.width) as u64;
        let neurons_bytes = capacity * params.width as u64 * 4;
        let operand = |name: &str, bytes: u64| gpu.operand_buffer(name, bytes, tuning.operands);
        let training = match purpose {
            Purpose::Render => None,
            Purpose::Train => {
                let ray_bytes = u64::from(chunk_rays(setup).min(setup.n_rays)) * params.width as u64 * 4;
                Some(LayerTraining {
                    sums: LayerSums {
                        sample_feature_gradient: gpu.buffer("sample_feature_gradient", capacity * 4, Memory::Device)?,
                        ray_dz: gpu.buffer("ray_dz", ray_bytes, Memory::Device)?,
                    },
                    dz: [operand("dz_even", neurons_bytes)?, operand("dz_odd", neurons_bytes)?],
                })
            }
        };
        Ok(LayerNetwork {
            kernels: LayerKernels::new(gpu, tuning.clone())?,
            buffers: LayerBuffers {
                sample_times: gpu.buffer("sample_times", capacity * size_of::<SampleTime>() as u64, Memory::Device)?,
                features: operand("features", capacity * params.encode_groups as u64 * 16)?,
                phase_bias: gpu.buffer("phase_bias", rows * F32_BYTES, Memory::Device)?,
            },
            activations: (0..params.layers.len())
                .map(|i| operand(&format!("activations_{i}"), neurons_bytes))
                .collect::<std::result::Result<_, _>>()?,
            training,
        })
    }

    /// Returns the input of a hidden layer that comes from the layer below; the first layer sees the encoding.
    fn below(&self, layer: usize) -> &Buffer {
        if layer == 0 { &self.buffers.features } else { &self.activations[layer - 1] }
    }

    fn training(&self) -> Result<&LayerTraining> {
        self.training.as_ref().ok_or_else(built_for_rendering)
    }

    /// Records the gradient at the output neuron, and dz of the last layer.
    fn record_output_backward(&self, map: &NetworkMap, pass: &mut Pass<'_>) -> Result<()> {
        let (k, params, training) = (&self.kernels, map, self.training()?);
        let groups = params.width as u32 / 4;
        let last = params.layers.len() - 1;
        let activations = (Binding::activations, (&self.activations[last]).into());
        let dz = (Binding::dz, (&training.dz[last % 2]).into());
        let push =
            push::MlpOutBwd { groups, weights4: params.out_weights as u32 / 4, capacity: pass.setup.sample_capacity };
        pass.run_with(&k.mlp_out_bwd, pass.buffers.per_sample(), &[activations, dz], push)
    }

    /// Records the gradient of the output neuron's weights.
    fn record_output_weight_gradient(&self, map: &NetworkMap, pass: &mut Pass<'_>, chunk: Chunk) -> Result<()> {
        let (k, params) = (&self.kernels, map);
        let activations = (Binding::activations, self.below(params.layers.len()).into());
        let PartialSums { splits, len: n_partials } = self.partial_sums(params);
        let push = push::MlpOutBwdWeight {
            weights: in_partials(params, params.out_weights),
            bias: in_partials(params, params.out_bias),
            capacity: pass.setup.sample_capacity,
            splits,
            n_partials,
            accumulate: chunk.accumulate(),
        };
        let groups = Groups::Direct([params.width as u32 / 4, splits, 1]);
        pass.run_with(&k.mlp_out_bwd_weight, groups, &[activations], push)
    }

    /// Records dz of the layer below `i`, which must exist.
    fn record_input_gradient(&self, map: &NetworkMap, pass: &mut Pass<'_>, i: usize, weights: usize) -> Result<()> {
        let (k, training) = (&self.kernels, self.training()?);
        let groups = map.width as u32 / 4;
        let bound = [
            (Binding::dz, (&training.dz[i % 2]).into()),
            (Binding::activations, (&self.activations[i - 1]).into()),
            (Binding::dz_in, (&training.dz[(i + 1) % 2]).into()),
        ];
        let push = push::MlpLayerBwdInput {
            out_groups: groups,
            in_groups: groups,
            weights4: weights as u32 / 4,
            capacity: pass.setup.sample_capacity,
        };
        pass.run_with(&k.mlp_layer_bwd_input, pass.buffers.backward_tiles(), &bound, push)
    }

    /// Records the gradient of a layer's weights on each of its inputs.
    fn record_weight_gradients(
        &self,
        map: &NetworkMap,
        pass: &mut Pass<'_>,
        i: usize,
        layer: &Layer,
        chunk: Chunk,
    ) -> Result<()> {
        let (k, params, training) = (&self.kernels, map, self.training()?);
        let (width, groups) = (params.width as u32, params.width as u32 / 4);
        let PartialSums { splits, len: n_partials } = self.partial_sums(params);
        let tile = k.tuning.tile();
        // Biases of layers without latents are summed here, once; the other biases come from the sums per phase.
        let mut bias = layer.latent.is_none().then(|| in_partials(params, layer.bias));
        let inputs = [
            (&self.buffers.features, params.encode_groups as u32, layer.encoded),
            (self.below(i), groups, layer.hidden),
        ];
        for (input, in_groups, at) in inputs {
            let Some(at) = at else { continue };
            let push = push::MlpLayerBwdWeight {
                in_groups,
                weights: in_partials(params, at),
                capacity: pass.setup.sample_capacity,
                splits,
                n_partials,
                accumulate: chunk.accumulate(),
                bias: bias.take().unwrap_or(NOWHERE),
                out_groups: groups,
            };
            let inputs_per_group = tile.weight_inputs * k.mlp_layer_bwd_weight.local_size();
            let tiles = [width.div_ceil(tile.weight_neurons), (4 * in_groups).div_ceil(inputs_per_group), splits];
            let bound = [(Binding::dz, (&training.dz[i % 2]).into()), (Binding::inputs, input.into())];
            pass.run_with(&k.mlp_layer_bwd_weight, Groups::Direct(tiles), &bound, push)?;
        }
        Ok(())
    }

    /// Records the sums of layer `i`'s dz over the rays of each phase.
    fn record_phase_sum(&self, map: &NetworkMap, pass: &mut Pass<'_>, i: usize, chunk: Chunk) -> Result<()> {
        let (k, params, training) = (&self.kernels, map, self.training()?);
        let groups = params.width as u32 / 4;
        let Chunk { first_ray, n_rays } = chunk;
        let rays = Groups::Direct([n_rays.div_ceil(k.mlp_ray_sum.local_size()), groups, 1]);
        let push = push::MlpRaySum { n_rays, capacity: pass.setup.sample_capacity };
        pass.run_with(&k.mlp_ray_sum, rays, &[(Binding::dz, (&training.dz[i % 2]).into())], push)?;
        let phases = Groups::Direct([groups, params.phases as u32, 1]);
        let row = (i * params.phases) as u32;
        let push = push::MlpPhaseSum { first_ray, n_rays, row, groups, accumulate: chunk.accumulate() };
        pass.run(&k.mlp_phase_sum, phases, push)
    }
}

/// Returns the position of a parameter of the network in a part of the partial sums, which have the order of the parameters.
fn in_partials(params: &NetworkMap, at: usize) -> u32 {
    (at - params.first) as u32
}

/// Minimum work of the stages: each reads what the stage before it wrote.
fn work(params: &NetworkMap, samples: u64) -> Ledger {
    let (width, encoded) = (params.width as u64, 4 * params.encode_groups as u64);
    let mut ledger = Ledger::new();
    let mut count = |stage: &str, flop: u64, numbers: u64, bytes: u64| {
        add(&mut ledger, stage, StageWork::per_item(samples, flop, numbers * F32_BYTES + bytes));
    };
    count("encode", 0, encoded, SAMPLE_BYTES);
    for layer in &params.layers {
        let inputs =
            [layer.encoded.map(|_| (params.encoded_len as u64, encoded)), layer.hidden.map(|_| (width, width))];
        for (used, stored) in inputs.into_iter().flatten() {
            count("mlp_layer_fwd", 2 * width * used, stored, 0);
            count("mlp_layer_bwd_weight", 2 * width * used, width + stored, 0);
        }
        count("mlp_layer_fwd", 0, width, 0);
        if layer.hidden.is_some() {
            count("mlp_layer_bwd_input", 2 * width * width, 3 * width, 0);
        }
    }
    count("mlp_out_fwd", 2 * width, width, SAMPLE_BYTES);
    count("mlp_out_bwd", 2 * width, 2 * width + 1, SAMPLE_BYTES);
    count("mlp_out_bwd_weight", 2 * width, width + 1, 0);
    ledger
}

impl Path for LayerNetwork {
    fn work(&self, params: &NetworkMap, samples: u64) -> Ledger {
        work(params, samples)
    }

    fn find(&self, name: Binding) -> Option<&Buffer> {
        self.buffers.find(name).or_else(|| self.training.as_ref()?.sums.find(name))
    }

    fn tiles(&self, params: &NetworkMap) -> Tiles {
        let (tile, width) = (self.kernels.tuning.tile(), params.width as u32);
        Tiles {
            samples: self.kernels.tuning.tile_samples(),
            forward: width.div_ceil(tile.fwd_neurons),
            backward: width.div_ceil(tile.bwd_inputs),
        }
    }

    fn partial_sums(&self, params: &NetworkMap) -> PartialSums {
        PartialSums { splits: self.kernels.tuning.splits, len: params.len as u32 }
    }

    fn gradient_source(&self, params: &NetworkMap) -> Vec<u32> {
        (0..params.len as u32).collect()
    }

    fn record_weights(&self, map: &NetworkMap, pass: &mut Pass<'_>) -> Result<()> {
        let (stage, params) = (&self.kernels.mlp_latent_fwd, map);
        let push = push::MlpLatentFwd { layers: params.layers.len() as u32, latents: params.latents as u32 };
        let rows = (params.layers.len() * params.phases * params.width) as u32;
        pass.run(stage, stage.groups_for(rows), push)
    }

    /// Records `encode`, `mlp_layer_fwd` of each layer and `mlp_out_fwd`.
    fn record_forward(&self, map: &NetworkMap, pass: &mut Pass<'_>) -> Result<()> {
        let (k, params, buffers) = (&self.kernels, map, pass.buffers);
        let capacity = pass.setup.sample_capacity;
        let (groups, encode_groups) = (params.width as u32 / 4, params.encode_groups as u32);
        pass.run(&k.encode, buffers.per_sample(), push::Encode {})?;
        for (i, layer) in params.layers.iter().enumerate() {
            let push = push::MlpLayerFwd {
                a_groups: layer.encoded.map_or(0, |_| encode_groups),
                b_groups: layer.hidden.map_or(0, |_| groups),
                a_weights4: layer.encoded.unwrap_or(0) as u32 / 4,
                b_weights4: layer.hidden.unwrap_or(0) as u32 / 4,
                bias: (i * params.phases * params.width) as u32,
                capacity,
                width: params.width as u32,
            };
            let bound = [
                (Binding::input_a, (&self.buffers.features).into()),
                (Binding::input_b, self.below(i).into()),
                (Binding::activations, (&self.activations[i]).into()),
            ];
            pass.run_with(&k.mlp_layer_fwd, buffers.forward_tiles(), &bound, push)?;
        }
        let push =
            push::MlpOutFwd { groups, weights4: params.out_weights as u32 / 4, bias: params.out_bias as u32, capacity };
        let bound = [(Binding::activations, self.below(params.layers.len()).into())];
        pass.run_with(&k.mlp_out_fwd, buffers.per_sample(), &bound, push)
    }

    /// Records the passes that write `partials` and `phase_dz`.
    fn record_backward(&self, map: &NetworkMap, pass: &mut Pass<'_>, chunk: Chunk) -> Result<()> {
        self.record_output_backward(map, pass)?;
        for (i, layer) in map.layers.iter().enumerate().rev() {
            if let (Some(weights), true) = (layer.hidden, i > 0) {
                // The input gradient goes first: none of the passes below writes what it reads, so that the three may overlap.
                self.record_input_gradient(map, pass, i, weights)?;
            }
            self.record_weight_gradients(map, pass, i, layer, chunk)?;
            if layer.latent.is_some() {
                self.record_phase_sum(map, pass, i, chunk)?;
            }
        }
        // This pass overlaps with the first layer's sums over phases. Passes of weight gradients share a buffer and wait for
        // one another.
        self.record_output_weight_gradient(map, pass, chunk)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Config, Preset};
    use crate::model::params::ParamMap;
    use crate::network::cost::NetworkCost;

    #[test]
    fn operations_of_the_stages_are_those_of_the_network() {
        for preset in [Preset::Paper, Preset::PublicCode, Preset::FastMlp] {
            let params = ParamMap::new(&Config::preset(preset), 10);
            let (ledger, cost) =
                (work(params.dynamic_network.as_ref().unwrap(), 1_000_000_000), NetworkCost::of(&params));
            let flop = |stages: &[&str]| stages.iter().map(|stage| ledger[*stage].gflop).sum::<f64>() as u64;
            assert_eq!(flop(&["mlp_layer_fwd", "mlp_out_fwd"]), cost.forward);
            assert_eq!(flop(&["mlp_layer_bwd_weight", "mlp_out_bwd_weight"]), cost.weights);
            assert_eq!(flop(&["mlp_layer_bwd_input", "mlp_out_bwd"]), cost.inputs);
        }
    }
}
