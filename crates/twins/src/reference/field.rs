//! f64 reference implementations (twins) of the fields: plain loops over one point at a time, forward and backward.

use crate::kernels::layout::Setup;
use crate::model::params::{NetworkMap, ParamMap};
use glam::{DVec3, Vec3};

/// log(1 + e^x), the identity above 20 as in torch.
pub fn softplus(x: f64) -> f64 {
    if x > 20.0 { x } else { x.exp().ln_1p() }
}

/// Derivative of [`softplus`].
pub fn sigmoid(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Converts a point of the constants that twins and shaders share.
pub(super) fn point(at: [f32; 3]) -> DVec3 {
    Vec3::from(at).as_dvec3()
}

/// Tells whether a point lies in the static field's box.
pub fn static_inside(s: &Setup, x: DVec3) -> bool {
    let (low, high) = (point(s.static_min), point(s.static_max));
    x.cmpge(low).all() && x.cmple(high).all()
}

/// Linear interpolation taps on an axis of `grid` points: cell and weight of its upper end.
fn tap(coordinate: f64, grid: usize) -> (usize, f64) {
    let cell = (coordinate.max(0.0) as usize).min(grid - 2);
    (cell, coordinate - cell as f64)
}

struct ModeTaps {
    plane: [(usize, f64); 4],
    line: [(usize, f64); 2],
}

/// Positions (without rank) and weights of the interpolation taps of each mode: XY x Z, XZ x Y, YZ x X.
fn vm_taps(s: &Setup, p: &ParamMap, x: DVec3) -> [ModeTaps; 3] {
    let (low, high) = (point(s.static_min), point(s.static_max));
    let c = (x - low) / (high - low) * (p.grid - 1) as f64;
    [[0, 1, 2], [0, 2, 1], [1, 2, 0]].map(|[u, v, w]| {
        let mode = 2 - w;
        let ((iu, fu), (iv, fv), (iw, fw)) = (tap(c[u], p.grid), tap(c[v], p.grid), tap(c[w], p.grid));
        ModeTaps {
            plane: [
                (p.plane(mode, 0, iv, iu), (1.0 - fu) * (1.0 - fv)),
                (p.plane(mode, 0, iv, iu + 1), fu * (1.0 - fv)),
                (p.plane(mode, 0, iv + 1, iu), (1.0 - fu) * fv),
                (p.plane(mode, 0, iv + 1, iu + 1), fu * fv),
            ],
            line: [(p.line(mode, 0, iw), 1.0 - fw), (p.line(mode, 0, iw + 1), fw)],
        }
    })
}

/// Sum over modes and ranks of plane times line factors (paper, section 2.1).
pub fn vm_feature(s: &Setup, p: &ParamMap, params: &[f64], x: DVec3) -> f64 {
    let mut sum = 0.0;
    for taps in vm_taps(s, p, x) {
        for r in 0..p.ranks {
            let at = |taps: &[(usize, f64)]| taps.iter().map(|(i, w)| w * params[i + r]).sum::<f64>();
            sum += at(&taps.plane) * at(&taps.line);
        }
    }
    sum
}

/// Adds `dL_dfeature` times the feature's gradient.
pub fn vm_feature_bwd(s: &Setup, p: &ParamMap, params: &[f64], x: DVec3, dl_dfeature: f64, gradient: &mut [f64]) {
    for taps in vm_taps(s, p, x) {
        for r in 0..p.ranks {
            let at = |taps: &[(usize, f64)]| taps.iter().map(|(i, w)| w * params[i + r]).sum::<f64>();
            let (plane, line) = (at(&taps.plane), at(&taps.line));
            taps.plane.iter().for_each(|(i, w)| gradient[i + r] += dl_dfeature * w * line);
            taps.line.iter().for_each(|(i, w)| gradient[i + r] += dl_dfeature * w * plane);
        }
    }
}

/// Attenuation of the static field, per world unit.
pub fn static_attenuation(s: &Setup, p: &ParamMap, params: &[f64], x: DVec3) -> f64 {
    f64::from(s.static_gain) * softplus(vm_feature(s, p, params, x) + f64::from(s.static_shift))
}

/// Windowed positional encoding: `[x, a_k sin(2^k x), a_k cos(2^k x)]`.
pub fn encode(s: &Setup, window: f64, x: DVec3) -> Vec<f64> {
    let x = (x - point(s.encode_centre)) * f64::from(s.encode_scale);
    let mut out = x.to_array().to_vec();
    for k in 0..s.n_bands {
        let open = (window - f64::from(k)).clamp(0.0, 1.0);
        let angle = x * f64::from(1u32 << k);
        out.extend(angle.to_array().map(|a| open * a.sin()));
        out.extend(angle.to_array().map(|a| open * a.cos()));
    }
    out
}

/// Precision of the network's operands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Precision {
    /// Everything in f64.
    Exact,
    /// Weights, encoding, activations and scaled gradients are rounded to f16 where the fused kernels round them.
    F16 {
        /// Factor on gradients before rounding.
        loss_scale: f64,
    },
}

impl Precision {
    fn round(self, x: f64) -> f64 {
        match self {
            Precision::Exact => x,
            // The kernels compute in f32 before rounding.
            Precision::F16 { .. } => half::f16::from_f32((x as f32).clamp(-65504.0, 65504.0)).to_f64(),
        }
    }

    fn loss_scale(self) -> f64 {
        match self {
            Precision::Exact => 1.0,
            Precision::F16 { loss_scale } => loss_scale,
        }
    }
}

/// Hidden activations of one sample, layer by layer, and the output feature.
#[derive(Default)]
pub struct NetworkTrace {
    /// Encoded input.
    pub encoded: Vec<f64>,
    /// Activations of each hidden layer.
    pub hidden: Vec<Vec<f64>>,
    /// Output before the activation.
    pub feature: f64,
}

/// Phases that a ray shows, and their shares; see [`BeatTime::shown`].
///
/// [`BeatTime::shown`]: crate::scan::gating::BeatTime::shown
pub type ShownPhases = [(usize, f64); 2];

/// Evaluates the network at one encoded point, at one phase or between two.
pub fn network_fwd(
    p: &NetworkMap,
    params: &[f64],
    encoded: &[f64],
    shown: ShownPhases,
    precision: Precision,
) -> NetworkTrace {
    let round = |x: f64| precision.round(x);
    let encoded: Vec<f64> = encoded.iter().map(|e| round(*e)).collect();
    let mut hidden: Vec<Vec<f64>> = Vec::new();
    for layer in &p.layers {
        let previous = hidden.last();
        let out = (0..p.width)
            .map(|j| {
                let mut z = params[layer.bias + j];
                if let Some(at) = layer.latent {
                    let weights = &params[at + j * p.latent..][..p.latent];
                    let row = |phase: usize| {
                        let latent = &params[p.latents + phase * p.latent..][..p.latent];
                        z + weights.iter().zip(latent).map(|(w, v)| w * v).sum::<f64>()
                    };
                    // In matrix products, bias and latent form a column of the weights, and shares are entries of the
                    // input.
                    z = shown.iter().map(|(phase, share)| round(row(*phase)) * round(*share)).sum();
                }
                if let Some(at) = layer.encoded {
                    let row = at + j * p.encode_groups * 4;
                    z += encoded.iter().enumerate().map(|(k, e)| round(params[row + k]) * e).sum::<f64>();
                }
                if let (Some(at), Some(h)) = (layer.hidden, previous) {
                    z += h.iter().enumerate().map(|(k, v)| round(params[at + j * p.width + k]) * v).sum::<f64>();
                }
                round(z.max(0.0))
            })
            .collect();
        hidden.push(out);
    }
    let last = hidden.last().map_or(&[][..], |h| h);
    let weight = |k: usize| round(params[p.out_weights + k]);
    let feature = params[p.out_bias] + last.iter().enumerate().map(|(k, h)| weight(k) * h).sum::<f64>();
    NetworkTrace { encoded, hidden, feature }
}

/// Adds `dL_dfeature` times the feature's gradient with respect to all network parameters.
pub fn network_bwd(
    p: &NetworkMap,
    params: &[f64],
    trace: &NetworkTrace,
    shown: ShownPhases,
    dl_dfeature: f64,
    precision: Precision,
    gradient: &mut [f64],
) {
    let round = |x: f64| precision.round(x);
    let scale = precision.loss_scale();
    let last = p.layers.len() - 1;
    gradient[p.out_bias] += dl_dfeature;
    // dz stays multiplied by the loss scale, as in f16 memory.
    let mut dz = vec![0.0; p.width];
    for (j, (h, dz)) in trace.hidden[last].iter().zip(&mut dz).enumerate() {
        gradient[p.out_weights + j] += dl_dfeature * h;
        *dz = if *h > 0.0 { round(scale * dl_dfeature * round(params[p.out_weights + j])) } else { 0.0 };
    }
    for (i, layer) in p.layers.iter().enumerate().rev() {
        let mut dz_in = vec![0.0; p.width];
        for (j, scaled) in dz.iter().enumerate() {
            let g = scaled / scale;
            // Where a layer has latents, its bias is part of the phases' rows.
            let rows = shown.iter().map(|(_, share)| round(*share)).sum::<f64>();
            gradient[layer.bias + j] += if layer.latent.is_some() { rows * g } else { g };
            if let Some(at) = layer.encoded {
                let row = at + j * p.encode_groups * 4;
                trace.encoded.iter().enumerate().for_each(|(k, e)| gradient[row + k] += g * e);
            }
            if let Some(at) = layer.latent {
                for (l, (phase, share)) in (0..p.latent).flat_map(|l| shown.map(|shown| (l, shown))) {
                    let (value, of_phase) = (p.latents + phase * p.latent + l, round(share) * g);
                    gradient[at + j * p.latent + l] += of_phase * params[value];
                    gradient[value] += of_phase * params[at + j * p.latent + l];
                }
            }
            if let (Some(at), true) = (layer.hidden, i > 0) {
                for (k, h) in trace.hidden[i - 1].iter().enumerate() {
                    gradient[at + j * p.width + k] += g * h;
                    if *h > 0.0 {
                        dz_in[k] += scaled * round(params[at + j * p.width + k]);
                    }
                }
            }
        }
        dz = dz_in.into_iter().map(round).collect();
    }
}
