//! One flat buffer of parameters: named slices with shape, offset and seeded initial values.
//!
//! Order: the static field, which is planes, then lines (both with ranks padded to a multiple of 4), or a network; then the
//! dynamic field's network: per hidden layer encoded-input weights, hidden weights, latent weights, bias; output weights,
//! output bias, latents. Every slice starts at a multiple of 4 so that shaders can read vec4. Padding is zero, gets zero
//! gradient and so stays zero.

use crate::config::Config;
use crate::config::fields::{FieldSettings, StaticField};
use crate::config::sections::Network;
use crate::random::{STREAM_INIT, normal, uniform01};
use std::ops::Range;

/// Standard deviation of the initial planes and lines, as in the authors' code.
const INIT_STD: f64 = 0.01;

/// Positions of the parts of one hidden layer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Layer {
    /// Weights on the encoded input, `[width][4 * encode_groups]`, if the layer sees it.
    pub encoded: Option<usize>,
    /// Weights on the previous layer, `[width][width]`, if there is one.
    pub hidden: Option<usize>,
    /// Weights on the phase's latent, `[width][latent]`, if the layer sees the input.
    pub latent: Option<usize>,
    /// Bias, `[width]`.
    pub bias: usize,
}

/// Positions of the parameters of a network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NetworkMap {
    /// Index of its first parameter.
    pub first: usize,
    /// Hidden layers in order.
    pub layers: Vec<Layer>,
    /// Output weights, `[width]`.
    pub out_weights: usize,
    /// Output bias (one number in a slice of 4).
    pub out_bias: usize,
    /// Latents, `[phases][latent]`.
    pub latents: usize,
    /// Neurons per hidden layer.
    pub width: usize,
    /// Length of the encoded input.
    pub encoded_len: usize,
    /// Length of the encoded input in vec4, rounded up.
    pub encode_groups: usize,
    /// Length of a latent; 0: the network is the same at all phases.
    pub latent: usize,
    /// Cardiac phases.
    pub phases: usize,
    /// Number of its parameters, padding included.
    pub len: usize,
}

/// Positions of all parameters.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParamMap {
    /// Cells per axis of the static field; 0 where it is a network or absent.
    pub grid: usize,
    /// Ranks per mode; 0 where the static field is a network or absent.
    pub ranks: usize,
    /// `ranks` rounded up to vec4, in vec4.
    pub rank4: usize,
    /// Number of parameters of the static field; those of the dynamic field follow.
    pub static_len: usize,
    /// The static field, where it is a network.
    pub static_network: Option<NetworkMap>,
    /// The dynamic field's network; `None` where Gaussians or the field of another method are the dynamic field.
    pub dynamic_network: Option<NetworkMap>,
    /// Cardiac phases.
    pub phases: usize,
    /// Number of all parameters, padding included.
    pub len: usize,
}

/// A part of the buffer under the name it has in a checkpoint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Tensor {
    /// Name, as documented in `docs/formats.md`.
    pub name: String,
    /// Shape without padding.
    pub shape: Vec<usize>,
    /// Position in the buffer of each element in row-major order of `shape`.
    pub positions: Vec<u32>,
}

impl NetworkMap {
    /// Returns the map of a network with the dynamic field's shape, from parameter `first` on, with `latent` numbers for each
    /// phase.
    fn new(shape: &Network, first: usize, latent: usize, phases: usize) -> NetworkMap {
        let width = shape.width as usize;
        let encoded_len = 3 + 6 * shape.bands as usize;
        let encode_groups = encoded_len.div_ceil(4);
        let mut next = first;
        let mut take = |len: usize| {
            let at = next;
            next += len.next_multiple_of(4);
            at
        };
        let layers = (0..shape.layers as usize)
            .map(|i| {
                let sees_input = i == 0 || i + 1 == shape.skip_layer as usize;
                Layer {
                    encoded: sees_input.then(|| take(width * encode_groups * 4)),
                    hidden: (i > 0).then(|| take(width * width)),
                    latent: (sees_input && latent > 0).then(|| take(width * latent)),
                    bias: take(width),
                }
            })
            .collect();
        let out_weights = take(width);
        let out_bias = take(1);
        let latents = take(phases * latent);
        let len = next - first;
        NetworkMap {
            first,
            layers,
            out_weights,
            out_bias,
            latents,
            width,
            encoded_len,
            encode_groups,
            latent,
            phases,
            len,
        }
    }

    /// Returns every tensor, whose name is prefixed by that of the field. A layer that sees the input has one weight matrix on
    /// `[encoded, latent]` or `[encoded, latent, hidden]`, as in the authors' code.
    fn tensors(&self, field: &str) -> Vec<Tensor> {
        let mut out = Vec::new();
        let mut push =
            |name: String, shape: Vec<usize>, positions: Vec<usize>| out.push(tensor(name, shape, positions));
        for (i, layer) in self.layers.iter().enumerate() {
            let mut at = Vec::new();
            let mut inputs = 0;
            for j in 0..self.width {
                let mut row = Vec::new();
                if let Some(start) = layer.encoded {
                    row.extend((0..self.encoded_len).map(|k| start + j * self.encode_groups * 4 + k));
                }
                if let Some(start) = layer.latent {
                    row.extend((0..self.latent).map(|k| start + j * self.latent + k));
                }
                if let Some(start) = layer.hidden {
                    row.extend((0..self.width).map(|k| start + j * self.width + k));
                }
                inputs = row.len();
                at.extend(row);
            }
            push(format!("{field}.layer{i}.weight"), vec![self.width, inputs], at);
            push(format!("{field}.layer{i}.bias"), vec![self.width], slice(layer.bias, self.width).collect());
        }
        push(format!("{field}.out.weight"), vec![1, self.width], slice(self.out_weights, self.width).collect());
        push(format!("{field}.out.bias"), vec![1], vec![self.out_bias]);
        if self.latent > 0 {
            let shape = vec![self.phases, self.latent];
            push(format!("{field}.latent"), shape, slice(self.latents, self.phases * self.latent).collect());
        }
        out
    }

    /// Returns the number of inputs of the linear layer that a tensor of [`NetworkMap::tensors`] belongs to; none for latents.
    fn inputs(&self, name: &str) -> Option<usize> {
        if name.ends_with(".latent") {
            return None;
        }
        let layer = name.split(".layer").nth(1).and_then(|rest| rest.split('.').next()?.parse::<usize>().ok());
        Some(layer.map_or(self.width, |i| {
            let Layer { encoded, hidden, .. } = &self.layers[i];
            encoded.map_or(0, |_| self.encoded_len + self.latent) + hidden.map_or(0, |_| self.width)
        }))
    }
}

fn slice(first: usize, len: usize) -> Range<usize> {
    first..first + len
}

fn tensor(name: String, shape: Vec<usize>, positions: Vec<usize>) -> Tensor {
    Tensor { name, shape, positions: positions.into_iter().map(|p| p as u32).collect() }
}

impl ParamMap {
    /// Returns the map for a configuration and a number of phases.
    pub fn new(config: &Config, phases: usize) -> ParamMap {
        ParamMap::of(config.fields().as_ref(), phases)
    }

    /// Returns the map for fields and a number of phases; an empty one without fields.
    pub fn of(settings: Option<&FieldSettings>, phases: usize) -> ParamMap {
        let network = settings.and_then(|settings| settings.network.as_ref());
        let (grid, ranks, static_network): (usize, usize, _) = match settings.map(|settings| &settings.static_field) {
            Some(StaticField::Tensor(tensor)) => (tensor.grid as usize, tensor.ranks as usize, None),
            Some(StaticField::Network(_)) => (0, 0, network.map(|shape| NetworkMap::new(shape, 0, 0, phases))),
            None => (0, 0, None),
        };
        let rank4 = ranks.div_ceil(4);
        let static_len = static_network.as_ref().map_or(3 * (grid * grid + grid) * rank4 * 4, |network| network.len);
        let dynamic_network = network.map(|shape| NetworkMap::new(shape, static_len, shape.latent as usize, phases));
        let len = static_len + dynamic_network.as_ref().map_or(0, |network| network.len);
        ParamMap { grid, ranks, rank4, static_len, static_network, dynamic_network, phases, len }
    }

    /// Returns the existing networks, the static field's first.
    pub fn networks(&self) -> impl Iterator<Item = &NetworkMap> {
        self.static_network.iter().chain(&self.dynamic_network)
    }

    /// Returns the number of parameters of the static field's lines, padding included; they are the last ones of the static
    /// field.
    pub fn line_len(&self) -> usize {
        3 * self.grid * self.rank4 * 4
    }

    /// Returns the position of plane element `(mode, rank, v, u)`; `u` runs along the plane's first axis.
    pub fn plane(&self, mode: usize, rank: usize, v: usize, u: usize) -> usize {
        ((mode * self.grid + v) * self.grid + u) * self.rank4 * 4 + rank
    }

    /// Returns the position of line element `(mode, rank, w)`.
    pub fn line(&self, mode: usize, rank: usize, w: usize) -> usize {
        (3 * self.grid * self.grid + mode * self.grid + w) * self.rank4 * 4 + rank
    }

    /// Returns every tensor under its documented name, without padding.
    pub fn tensors(&self) -> Vec<Tensor> {
        let mut out =
            self.static_network.as_ref().map_or_else(|| self.planes_and_lines(), |network| network.tensors("static"));
        out.extend(self.dynamic_network.iter().flat_map(|network| network.tensors("dynamic")));
        out
    }

    fn planes_and_lines(&self) -> Vec<Tensor> {
        let mut out = Vec::new();
        if self.grid == 0 {
            return out;
        }
        for (mode, plane) in ["xy", "xz", "yz"].into_iter().enumerate() {
            let mut at = Vec::new();
            for r in 0..self.ranks {
                for v in 0..self.grid {
                    at.extend((0..self.grid).map(|u| self.plane(mode, r, v, u)));
                }
            }
            out.push(tensor(format!("static.plane.{plane}"), vec![self.ranks, self.grid, self.grid], at));
        }
        for (mode, line) in ["z", "y", "x"].into_iter().enumerate() {
            let at = (0..self.ranks).flat_map(|r| (0..self.grid).map(move |w| (r, w)));
            let at = at.map(|(r, w)| self.line(mode, r, w)).collect();
            out.push(tensor(format!("static.line.{line}"), vec![self.ranks, self.grid], at));
        }
        out
    }

    /// Returns the initial values: planes and lines `INIT_STD * N(0, 1)`, linear layers uniform in `+-1/sqrt(inputs)` (torch's
    /// default), latents uniform in [0, 1).
    pub fn initial(&self, seed: u32) -> Vec<f32> {
        let mut params = vec![0f32; self.len];
        for (index, tensor) in self.tensors().into_iter().enumerate() {
            let is_static = tensor.name.starts_with("static.");
            let network = if is_static { self.static_network.as_ref() } else { self.dynamic_network.as_ref() };
            let inputs = network.map(|network| network.inputs(&tensor.name));
            for (i, &at) in tensor.positions.iter().enumerate() {
                let (a, b) = (index as u32, i as u32);
                params[at as usize] = match inputs {
                    Some(Some(n)) => (uniform01(seed, STREAM_INIT, a, b) * 2.0 - 1.0) / (n as f64).sqrt(),
                    Some(None) => uniform01(seed, STREAM_INIT, a, b),
                    None => INIT_STD * normal(seed, STREAM_INIT, a, b),
                } as f32;
            }
        }
        params
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    #[test]
    fn slices_are_aligned_disjoint_and_named() {
        for preset in [Preset::FastMlp, Preset::Paper, Preset::PublicCode, Preset::NerfCa, Preset::R2Gaussian] {
            let config = Config::preset(preset);
            let map = ParamMap::new(&config, 10);
            let mut seen = vec![false; map.len];
            for tensor in map.tensors() {
                assert_eq!(tensor.positions.len(), tensor.shape.iter().product::<usize>());
                for at in tensor.positions {
                    assert!(!std::mem::replace(&mut seen[at as usize], true), "{} overlaps", tensor.name);
                }
            }
            let mut layers = map.networks().flat_map(|network| &network.layers);
            assert!(layers.all(|l| l.bias % 4 == 0 && l.hidden.unwrap_or(0) % 4 == 0));
        }
    }

    #[test]
    fn public_code_has_the_authors_shapes() {
        let map = ParamMap::new(&Config::preset(Preset::PublicCode), 10);
        let shapes: Vec<_> =
            map.tensors().into_iter().filter(|t| t.name.ends_with("weight")).map(|t| t.shape).collect();
        let want = [[128, 71], [128, 128], [128, 128], [128, 199], [128, 128], [1, 128]];
        assert_eq!(shapes, want.map(Vec::from));
    }

    #[test]
    fn nerf_ca_has_the_parameters_of_its_authors() {
        let map = ParamMap::new(&Config::preset(Preset::NerfCa), 10);
        let count = |field: &str| {
            let of_field = |t: &Tensor| t.name.starts_with(field);
            map.tensors().iter().filter(|t| of_field(t)).map(|t| t.positions.len()).sum::<usize>()
        };
        assert_eq!((count("static."), count("dynamic.")), (75_905, 76_929 + 80));
    }

    #[test]
    fn layers_start_within_one_over_the_root_of_their_inputs() {
        let config = Config::preset(Preset::NerfCa);
        let map = ParamMap::new(&config, 10);
        let params = map.initial(config.seed);
        for (name, inputs) in [
            ("static.layer0.weight", 75.0),
            ("static.layer3.bias", 128.0),
            ("dynamic.layer0.bias", 83.0),
            ("dynamic.out.weight", 128.0),
        ] {
            let tensor = map.tensors().into_iter().find(|t| t.name == name).unwrap();
            let largest = tensor.positions.iter().map(|at| params[*at as usize].abs()).fold(0.0, f32::max);
            let max = 1.0 / f32::sqrt(inputs);
            assert!(largest <= max && largest > 0.9 * max, "{name}: {largest} of {max}");
        }
    }
}
