//! f64 reference implementation (twin) for two networks as fields: integrals of both along a ray, their losses, and the
//! gradient at each sample (`march_fwd_samples`, `loss_samples`).

use crate::fields::data::FieldData;
use crate::reference::field::{self, NetworkTrace, Precision, ShownPhases};
use crate::reference::losses::Losses;
use crate::reference::march::{self, Ray};
use glam::DVec3;

/// Offset against division by zero and logarithms of zero, as in `loss_samples`.
const SMALL: f64 = 1e-10;
/// Minimum share of a field, and minimum integral as a divisor.
const SMALLEST: f64 = 1e-19;

/// Both fields at a sample of a ray.
#[derive(Debug, Clone, Copy)]
pub struct PairSample {
    /// Path length.
    pub dl: f64,
    /// Whether it counts as near.
    pub near: bool,
    /// Attenuation of the static and of the dynamic field, per world unit.
    pub sigma: [f64; 2],
}

/// Integrals and maxima of both fields along a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairIntegrals {
    /// Line integrals of the static and of the dynamic field.
    pub fields: [f64; 2],
    /// Line integral of the dynamic field over near samples.
    pub near: f64,
    /// Maximum attenuation of the static field, of the dynamic field, and of their sum.
    pub largest: [f64; 3],
}

/// Line integrals and maxima (twin of `march_fwd_samples`).
pub fn integrals(samples: &[PairSample]) -> PairIntegrals {
    let mut seen = PairIntegrals { fields: [0.0; 2], near: 0.0, largest: [0.0; 3] };
    for PairSample { dl, near, sigma: [of_static, of_dynamic] } in samples.iter().copied() {
        seen.fields[0] += of_static * dl;
        seen.fields[1] += of_dynamic * dl;
        seen.near += if near { of_dynamic * dl } else { 0.0 };
        for (largest, value) in seen.largest.iter_mut().zip([of_static, of_dynamic, of_static + of_dynamic]) {
            *largest = largest.max(value);
        }
    }
    seen
}

/// Contribution of one ray to the losses, unweighted except for the photometric loss, which has the ray's weight.
#[derive(Debug, Clone, Default)]
pub struct PairLoss {
    /// Photometric.
    pub data: f64,
    /// Squared residual.
    pub squared_error: f64,
    /// Entropy of the fields' shares.
    pub favour_static: f64,
    /// Entropy of the dynamic field along the ray.
    pub ray_entropy: f64,
    /// Integral of the dynamic field's near samples.
    pub near: f64,
    /// Sum of the static field's integrals per sample and of their squares.
    pub static_size: f64,
    /// Derivative of the objective by both attenuations at each sample.
    pub gradient: Vec<[f64; 2]>,
}

/// Losses of one of `n_rays` rays at a step, whose integrals of both fields are S and D (twin of `loss_samples`).
pub fn ray_loss(
    plan: &FieldData,
    step: u32,
    n_rays: usize,
    ray: &Ray,
    [s, d]: [f64; 2],
    samples: &[PairSample],
) -> PairLoss {
    let (setup, row) = (&plan.setup, plan.schedule[step as usize]);
    let (per_ray, per_depth) = (1.0 / n_rays as f64, 1.0 / (n_rays as f64 * f64::from(setup.n_dynamic_samples)));
    let weight = 1.0 + f64::from(setup.change_weight) * ray.change;
    let residual = s + d - ray.target;
    let counts = d >= f64::from(setup.min_integral) || ray.change > f64::from(setup.min_change);
    let entropy_scale = if counts { per_ray } else { 0.0 };
    let integral = d.max(SMALLEST);
    let share = |sample: &PairSample| sample.sigma[1] * sample.dl / integral;
    let slope = |p: f64| (p + SMALL).ln() + p / (p + SMALL);
    // Where D is too small, the divisor is a constant, so its derivative vanishes.
    let mean = if d > SMALLEST { samples.iter().map(|x| share(x) * slope(share(x))).sum() } else { 0.0 };
    let mut loss = PairLoss {
        data: per_ray * weight * residual * residual,
        squared_error: per_ray * residual * residual,
        ..PairLoss::default()
    };
    for sample in samples {
        let PairSample { dl, near, sigma: [of_static, of_dynamic] } = *sample;
        let sum = of_static + of_dynamic + SMALL;
        let (b, rest) = ((of_dynamic / sum).max(SMALLEST), ((of_static + SMALL) / sum).max(SMALLEST));
        let by_share = if b > SMALLEST && rest > SMALLEST { (rest / b).ln() } else { 0.0 };
        let (p, size) = (share(sample), of_static * dl);
        loss.favour_static -= per_depth * (b * b.ln() + rest * rest.ln());
        loss.ray_entropy -= entropy_scale * p * (p + SMALL).ln();
        loss.near += if near { per_ray * of_dynamic * dl } else { 0.0 };
        loss.static_size += size + size * size;
        let photometric = 2.0 * per_ray * weight * residual * dl;
        let favour = f64::from(row.favour_static) * per_depth * by_share / (sum * sum);
        let along = f64::from(row.ray_entropy) * entropy_scale * dl / integral * (slope(p) - mean);
        let near = if near { f64::from(row.near_integral) * per_ray * dl } else { 0.0 };
        loss.gradient.push([
            photometric - favour * of_dynamic + f64::from(row.static_size) * dl * (1.0 + 2.0 * size),
            photometric + favour * (of_static + SMALL) - along + near,
        ]);
    }
    loss
}

/// Place at which a network is evaluated.
#[derive(Debug, Clone, Copy)]
pub struct SamplePlace {
    /// The point.
    pub x: DVec3,
    /// Phases that its ray shows.
    pub shown: ShownPhases,
}

/// Evaluates both networks at a place, the static field's first.
pub fn traces(
    plan: &FieldData,
    params: &[f64],
    step: u32,
    SamplePlace { x, shown }: SamplePlace,
    precision: Precision,
) -> [NetworkTrace; 2] {
    let encoded = field::encode(&plan.setup, plan.schedule[step as usize].window.into(), x);
    let mut traces = plan.params.networks().map(|map| field::network_fwd(map, params, &encoded, shown, precision));
    std::array::from_fn(|_| traces.next().unwrap_or_default())
}

/// Attenuations of both networks, and their derivatives by the features.
pub fn attenuations(plan: &FieldData, traces: &[NetworkTrace; 2]) -> [[f64; 2]; 2] {
    let s = &plan.setup;
    let [of_static, of_dynamic] = [(s.static_gain, s.static_shift), (s.dynamic_gain, s.dynamic_shift)];
    let of = |trace: &NetworkTrace, (gain, shift): (f32, f32)| {
        let x = trace.feature + f64::from(shift);
        [f64::from(gain) * field::softplus(x), f64::from(gain) * field::sigmoid(x)]
    };
    [of(&traces[0], of_static), of(&traces[1], of_dynamic)]
}

/// Adds the gradient of a sample, given the derivative of the objective by both attenuations.
pub fn sample_bwd(
    plan: &FieldData,
    params: &[f64],
    SamplePlace { shown, .. }: SamplePlace,
    traces: &[NetworkTrace; 2],
    by_sigma: [f64; 2],
    precision: Precision,
    gradient: &mut [f64],
) {
    let slopes = attenuations(plan, traces).map(|[_, slope]| slope);
    for (k, map) in plan.params.networks().enumerate().take(by_sigma.len()) {
        field::network_bwd(map, params, &traces[k], shown, by_sigma[k] * slopes[k], precision, gradient);
    }
}

/// Places of a ray with their path lengths and whether they are near, which are shared by both fields.
fn places(plan: &FieldData, step: u32, ray: &Ray) -> Vec<(SamplePlace, f64, bool)> {
    let s = &plan.setup;
    march::depths(s, s.n_dynamic_samples, s.dynamic_near, s.dynamic_far, step, ray)
        .into_iter()
        .map(|(t, dl)| {
            let place = SamplePlace { x: ray.anchor + t * ray.direction, shown: ray.shown };
            (place, dl, t < f64::from(s.occlusion_depth))
        })
        .filter(|(place, ..)| march::searched(plan, place.x, ray, |_| true))
        .collect()
}

/// Integrals of a ray at a step, for fields with these parameters.
pub fn seen(plan: &FieldData, params: &[f64], step: u32, ray: &Ray, precision: Precision) -> PairIntegrals {
    let sample = |(place, dl, near): (SamplePlace, f64, bool)| {
        let sigma = attenuations(plan, &traces(plan, params, step, place, precision)).map(|[sigma, _]| sigma);
        PairSample { dl, near, sigma }
    };
    integrals(&places(plan, step, ray).into_iter().map(sample).collect::<Vec<_>>())
}

/// Loss and gradient of given rays at a step.
pub fn loss_and_gradient(
    plan: &FieldData,
    params: &[f64],
    step: u32,
    rays: &[Ray],
    precision: Precision,
) -> (Losses, Vec<f64>) {
    let row = plan.schedule[step as usize];
    let mut gradient = vec![0.0; plan.params.len];
    let mut losses = Losses::default();
    for ray in rays {
        let places = places(plan, step, ray);
        let all: Vec<_> = places.iter().map(|(place, ..)| traces(plan, params, step, *place, precision)).collect();
        let sample = |((_, dl, near), traces): (&(SamplePlace, f64, bool), &[NetworkTrace; 2])| PairSample {
            dl: *dl,
            near: *near,
            sigma: attenuations(plan, traces).map(|[sigma, _]| sigma),
        };
        let samples: Vec<_> = places.iter().zip(&all).map(sample).collect();
        let loss = ray_loss(plan, step, rays.len(), ray, integrals(&samples).fields, &samples);
        losses.data += loss.data;
        losses.dynamic += loss.data;
        losses.occlusion += f64::from(row.near_integral) * loss.near;
        losses.favour_static += f64::from(row.favour_static) * loss.favour_static;
        losses.ray_entropy += f64::from(row.ray_entropy) * loss.ray_entropy;
        losses.static_size += f64::from(row.static_size) * loss.static_size;
        losses.live += samples.len();
        for ((place, ..), (traces, by_sigma)) in places.iter().zip(all.iter().zip(&loss.gradient)) {
            sample_bwd(plan, params, *place, traces, *by_sigma, precision, &mut gradient);
        }
    }
    (losses, gradient)
}
