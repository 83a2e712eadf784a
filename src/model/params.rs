//! One flat buffer of parameters: named slices with shape, offset and seeded initial values.
//!
//! Order: static planes, static lines (both with ranks padded to a multiple of 4), then the network:
//! per hidden layer encoded-input weights, hidden weights, latent weights, bias; output weights, output
//! bias, latents. Every slice starts at a multiple of 4 so that shaders can read vec4. Padding is zero,
//! gets zero gradient and so stays zero.

use crate::config::Config;
use crate::random::{STREAM_INIT, normal, uniform01};

/// Where the parts of one hidden layer live.
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

/// Where every parameter lives.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ParamMap {
    /// Cells per axis of the static field.
    pub grid: usize,
    /// Ranks per mode.
    pub ranks: usize,
    /// `ranks` rounded up to vec4, in vec4.
    pub rank4: usize,
    /// Parameters of the static field; the network follows.
    pub static_len: usize,
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
    /// Numbers of the encoded input.
    pub encoded_len: usize,
    /// Length of the encoded input in vec4, rounded up.
    pub encode_groups: usize,
    /// Numbers of a latent.
    pub latent: usize,
    /// Cardiac phases.
    pub phases: usize,
    /// All parameters, padding included.
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

impl ParamMap {
    /// Map for a configuration and a number of phases.
    pub fn new(config: &Config, phases: usize) -> ParamMap {
        let (s, d) = (&config.static_field, &config.dynamic);
        let (grid, ranks) = (s.grid as usize, s.ranks as usize);
        let (width, latent) = (d.width as usize, d.latent as usize);
        let rank4 = ranks.div_ceil(4);
        let static_len = 3 * (grid * grid + grid) * rank4 * 4;
        let encoded_len = 3 + 6 * d.bands as usize;
        let encode_groups = encoded_len.div_ceil(4);
        let mut next = static_len;
        let mut take = |len: usize| {
            let at = next;
            next += len.next_multiple_of(4);
            at
        };
        let layers = (0..d.layers as usize)
            .map(|i| {
                let sees_input = i == 0 || i + 1 == d.skip_layer as usize;
                Layer {
                    encoded: sees_input.then(|| take(width * encode_groups * 4)),
                    hidden: (i > 0).then(|| take(width * width)),
                    latent: sees_input.then(|| take(width * latent)),
                    bias: take(width),
                }
            })
            .collect();
        let out_weights = take(width);
        let out_bias = take(1);
        let latents = take(phases * latent);
        ParamMap {
            grid,
            ranks,
            rank4,
            static_len,
            layers,
            out_weights,
            out_bias,
            latents,
            width,
            encoded_len,
            encode_groups,
            latent,
            phases,
            len: next,
        }
    }

    /// Parameters of the network, padding included; they follow those of the static field.
    pub fn network_len(&self) -> usize {
        self.len - self.static_len
    }

    /// Numbers on the lines of the static field, padding included; they are its last.
    pub fn line_len(&self) -> usize {
        3 * self.grid * self.rank4 * 4
    }

    /// Position of plane element `(mode, rank, v, u)`; `u` runs along the plane's first axis.
    pub fn plane(&self, mode: usize, rank: usize, v: usize, u: usize) -> usize {
        ((mode * self.grid + v) * self.grid + u) * self.rank4 * 4 + rank
    }

    /// Position of line element `(mode, rank, w)`.
    pub fn line(&self, mode: usize, rank: usize, w: usize) -> usize {
        (3 * self.grid * self.grid + mode * self.grid + w) * self.rank4 * 4 + rank
    }

    /// Every tensor under its documented name, padding left out. A layer that sees the input has one
    /// weight matrix on `[encoded, latent]` or `[encoded, latent, hidden]`, as in the authors' code.
    pub fn tensors(&self) -> Vec<Tensor> {
        let mut out = Vec::new();
        let mut push = |name: String, shape: Vec<usize>, positions: Vec<usize>| {
            out.push(Tensor { name, shape, positions: positions.into_iter().map(|p| p as u32).collect() });
        };
        for (mode, plane) in ["xy", "xz", "yz"].into_iter().enumerate() {
            let mut at = Vec::new();
            for r in 0..self.ranks {
                for v in 0..self.grid {
                    at.extend((0..self.grid).map(|u| self.plane(mode, r, v, u)));
                }
            }
            push(format!("static.plane.{plane}"), vec![self.ranks, self.grid, self.grid], at);
        }
        for (mode, line) in ["z", "y", "x"].into_iter().enumerate() {
            let at = (0..self.ranks).flat_map(|r| (0..self.grid).map(move |w| (r, w)));
            let at = at.map(|(r, w)| self.line(mode, r, w)).collect();
            push(format!("static.line.{line}"), vec![self.ranks, self.grid], at);
        }
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
            push(format!("dynamic.layer{i}.weight"), vec![self.width, inputs], at);
            push(format!("dynamic.layer{i}.bias"), vec![self.width], (layer.bias..layer.bias + self.width).collect());
        }
        push(
            "dynamic.out.weight".into(),
            vec![1, self.width],
            (self.out_weights..self.out_weights + self.width).collect(),
        );
        push("dynamic.out.bias".into(), vec![1], vec![self.out_bias]);
        push(
            "dynamic.latent".into(),
            vec![self.phases, self.latent],
            (self.latents..self.latents + self.phases * self.latent).collect(),
        );
        out
    }

    /// Initial values: planes and lines `init_std * N(0, 1)`, linear layers uniform in
    /// `+-1/sqrt(inputs)` (torch's default), latents uniform in [0, 1).
    pub fn initial(&self, config: &Config) -> Vec<f32> {
        let mut params = vec![0f32; self.len];
        for (index, tensor) in self.tensors().into_iter().enumerate() {
            let inputs = match tensor.name.as_str() {
                "dynamic.out.weight" | "dynamic.out.bias" => Some(self.width),
                "dynamic.latent" => None,
                name if name.starts_with("dynamic.layer") => Some(self.layer_inputs(name)),
                _ => None,
            };
            for (i, &at) in tensor.positions.iter().enumerate() {
                let (a, b) = (index as u32, i as u32);
                params[at as usize] = match inputs {
                    Some(n) => (uniform01(config.seed, STREAM_INIT, a, b) * 2.0 - 1.0) / (n as f64).sqrt(),
                    None if tensor.name == "dynamic.latent" => uniform01(config.seed, STREAM_INIT, a, b),
                    None => config.static_field.init_std * normal(config.seed, STREAM_INIT, a, b),
                } as f32;
            }
        }
        params
    }

    fn layer_inputs(&self, name: &str) -> usize {
        let index: usize = name.chars().filter(char::is_ascii_digit).collect::<String>().parse().unwrap_or(0);
        let layer = &self.layers[index];
        layer.encoded.map_or(0, |_| self.encoded_len + self.latent) + layer.hidden.map_or(0, |_| self.width)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Preset;

    #[test]
    fn slices_are_aligned_disjoint_and_named() {
        for preset in [Preset::FastMlp, Preset::Paper, Preset::PublicCode] {
            let config = Config::preset(preset);
            let map = ParamMap::new(&config, 10);
            let mut seen = vec![false; map.len];
            for tensor in map.tensors() {
                assert_eq!(tensor.positions.len(), tensor.shape.iter().product::<usize>());
                for at in tensor.positions {
                    assert!(!std::mem::replace(&mut seen[at as usize], true), "{} overlaps", tensor.name);
                }
            }
            assert!(map.layers.iter().all(|l| l.bias % 4 == 0 && l.hidden.unwrap_or(0) % 4 == 0));
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
}
