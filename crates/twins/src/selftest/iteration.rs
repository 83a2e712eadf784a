//! One iteration on the two fields, stage by stage. Each stage is compared on what the device itself made for it, as far as
//! its input can be read, so that a fault shows in the row of its stage.

use crate::choice::Choice;
use crate::config::Preset;
use crate::error::Result;
use crate::fields::data::FieldData;
use crate::fields::step::tv_parts;
use crate::fields::trainer::FieldsFit;
use crate::fitting::losses::{NetworkLosses, StepLoss};
use crate::gpu::capabilities::DeviceInfo;
use crate::gpu::device::Gpu;
use crate::kernels::constants::NEAR_SAMPLE;
use crate::kernels::layout::{self, RayOut};
use crate::kernels::push::{self, PushConstants};
use crate::kernels::tuning::{Layers, Tuning};
use crate::model::params::{ParamMap, Tensor};
use crate::network::chunk::chunks;
use crate::network::fused::computes_again;
use crate::network::{FIRST_LOSS_SCALE, FIRST_LOSS_SCALE_OF_TWO};
use crate::plan::Plan;
use crate::reference::field::{self, Precision, ShownPhases};
use crate::reference::{march, step};
use crate::scan::dataset::Dataset;
use crate::selftest::compare::{Findings, Tolerance, told};
use crate::selftest::problems::{FAST_NETWORK, PAPER_NETWORK, PUBLIC_NETWORK, small_config};
use crate::train::trainer::Trainer;
use glam::DVec3;

/// With the paper's learning rate, networks this small are dead after one update, and only zeros would be left to compare.
pub const STEADY: &[&str] = &["dynamic.lr=1e-3", "dynamic.lr_end=1e-4"];

/// A configuration whose gradients are compared.
#[derive(Debug, Clone, Copy)]
pub struct Case {
    /// Preset that the settings modify.
    pub preset: Preset,
    /// Settings, beside those of [`small_config`].
    pub settings: &'static [&'static str],
}

const fn case(preset: Preset, settings: &'static [&'static str]) -> Case {
    Case { preset, settings }
}

impl Case {
    pub(super) fn name(&self) -> String {
        [&[self.preset.name()], self.settings].concat().join(" ")
    }

    /// Its plan.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] for a setting that is not usable.
    pub fn plan(&self, dataset: &Dataset) -> Result<Plan> {
        let settings = [STEADY, self.settings].concat();
        let mut plan = Plan::new(&small_config(self.preset, &settings)?, dataset)?;
        if self.settings.iter().any(|setting| setting.starts_with("dynamic.min_slope")) {
            // Every ray asks for more attenuation.
            plan.data_mut::<FieldData>()?.images.iter_mut().flatten().for_each(|value| *value += 1.0);
        }
        Ok(plan)
    }
}

/// Cases of the f32 layers. Each covers a branch the others do not.
pub const F32_CASES: &[Case] = &[
    case(PAPER_NETWORK, &["dynamic.occlusion=1e-3"]),
    case(PUBLIC_NETWORK, &["dynamic.occlusion=1e-3"]),
    case(FAST_NETWORK, &[]),
    // odd bands, five ranks (two vec4), no power of two anywhere, batch of one ray
    case(
        FAST_NETWORK,
        &["dynamic.bands=5", "static.ranks=5", "static.grid=7", "train.rays=4", "march.dynamic_samples=33"],
    ),
    // more than 32 depths a lane
    case(FAST_NETWORK, &["march.dynamic_samples=1100", "train.rays=3", "train.chunk_samples=3500"]),
    // a field far below the bend of its softplus, which rays bring back
    case(FAST_NETWORK, &["dynamic.best_start=false", "dynamic.normalised_shift=-9", "dynamic.min_slope=0.05"]),
    // a single hidden layer, skip in a deep net, wide layers
    case(PAPER_NETWORK, &["dynamic.layers=1", "dynamic.width=16", "loss.normalise=true"]),
    case(PUBLIC_NETWORK, &["dynamic.layers=6", "dynamic.skip_layer=3", "dynamic.width=48", "dynamic.latent=12"]),
];

/// Cases of the layers on matrices. Each covers what the others do not: no skip and a skip layer; the skip layer last; one
/// layer; odd bands; several chunks; more tiles than workgroups; fewer samples than a tile.
pub const MATRIX_CASES: &[Case] = &[
    case(FAST_NETWORK, &["dynamic.width=48", "dynamic.bands=5"]),
    case(PUBLIC_NETWORK, &["dynamic.occlusion=1e-3", "loss.normalise=true"]),
    case(FAST_NETWORK, &["dynamic.layers=3", "dynamic.skip_layer=3", "dynamic.width=64", "train.rays=100"]),
    case(PAPER_NETWORK, &["dynamic.layers=1", "dynamic.width=16", "loss.normalise=true", "dynamic.latent=12"]),
    case(FAST_NETWORK, &["train.rays=1", "march.dynamic_samples=7"]),
];

/// Cases on matrices that are compared on images between phases, too. In the other cases some activation is so near zero there
/// that the order of a sum decides whether it counts.
pub const MATRIX_CASES_BETWEEN_PHASES: &[Case] = &[MATRIX_CASES[0], MATRIX_CASES[1]];

const RAYS: &[&str] = &[push::Batch::SHADER];
const SAMPLES: &[&str] = &[push::MarchCount::SHADER, push::MarchScan::SHADER, push::MarchEmit::SHADER];
const FORWARD: &[&str] =
    &[push::MlpLatentFwd::SHADER, push::Encode::SHADER, push::MlpLayerFwd::SHADER, push::MlpOutFwd::SHADER];
const FORWARD_ON_MATRICES: &[&str] = &[push::MlpPack::SHADER, push::MlpFusedFwd::SHADER];
const LOSS: &[&str] = &[push::MarchLoss::SHADER];
const STATIC_GRADIENT: &[&str] = &[push::MarchLoss::SHADER, push::GradientStatic::SHADER];
const OUTPUT_BACKWARD: &[&str] =
    &[push::MlpOutBwd::SHADER, push::MlpOutBwdWeight::SHADER, push::GradientNetwork::SHADER];
const LAYERS_BACKWARD: &[&str] = &[push::MlpLayerBwdInput::SHADER, push::MlpLayerBwdWeight::SHADER];
const BACKWARD_ON_MATRICES: &[&str] = &[push::MlpFusedBwd::SHADER, push::GradientNetwork::SHADER];
/// Backward stages where the first layer is recomputed.
const BACKWARD_AGAIN_ON_MATRICES: &[&str] =
    &[push::MlpFusedBwd::SHADER, push::MlpFusedBwdFirst::SHADER, push::GradientNetwork::SHADER];
const LATENTS_BACKWARD: &[&str] = &[push::MlpRaySum::SHADER, push::MlpPhaseSum::SHADER, push::MlpLatentBwd::SHADER];
const LATENTS_BACKWARD_ON_MATRICES: &[&str] = &[push::MlpLatentBwd::SHADER];
const TOTAL_VARIATION: &[&str] = &[push::GradientStatic::SHADER];
const ADAM: &[&str] = &[push::Adam::SHADER];
const REPORT: &[&str] = &[push::Report::SHADER];
/// All stages of an iteration at once.
const WHOLE: &[&str] = &["whole iteration"];
/// Gradients on matrices beside those in f64.
const F16_BESIDE_F64: &[&str] = &["f16 beside f64"];

/// Tolerances of a path.
pub(super) struct Tolerances {
    /// Attenuation at samples.
    pub(super) sigma: Tolerance,
    /// Gradient of a tensor.
    pub(super) gradient: Tolerance,
    /// Losses.
    pub(super) loss: f64,
}

/// Deviation of gradients where rounding puts a few inputs of ReLUs on the other side of zero: the gradient of such a neuron gains or
/// loses a sample, and so do the layers below. SwiftShader, whose attenuations deviate by 6e-6, reaches 2.7e-3.
const CROSSED_KINKS: f64 = 5e-3;
/// f32 sums of a few thousand terms; ReLU kinks are not crossed by the rounding of llvmpipe in these cases.
const IN_F32: Tolerances = Tolerances { sigma: F32_SUMS, gradient: F32_SUMS, loss: 2e-5 };
/// Numbers that are sums in f32.
pub(super) const F32_SUMS: Tolerance = Tolerance::OfLargest(1e-4);
/// The twin rounds to f16 where the kernels do; sums in f32 now and then round to the other neighbour.
const ON_MATRICES: Tolerances =
    Tolerances { sigma: Tolerance::OfLargest(2e-3), gradient: Tolerance::OfNorm(2e-4), loss: 1e-4 };
/// Gradients on matrices beside those of plain f64: what f16 costs.
const F16_COST: Tolerance = Tolerance::OfNorm(3e-2);
/// Points of rays and samples, world units: rounding of f32.
const POSITION: f64 = 2e-6;
/// Samples on a cell's face may fall either way in f32.
const STRAY_SAMPLES: f64 = 2.0;
/// Steps of the optimiser beside the largest: what f32 parameters lose of them.
const UPDATE: Tolerance = Tolerance::OfLargest(2e-3);

/// The twin's side of a comparison.
struct Twin<'a> {
    plan: &'a FieldData,
    step: u32,
    params: &'a [f64],
    rays: Vec<march::Ray>,
    precision: Precision,
    tolerances: Tolerances,
    /// Whether the backward pass computes the first layer again.
    computes_again: bool,
}

/// Results of an iteration on the device.
struct DeviceResults {
    loss: StepLoss,
    rays: Vec<layout::Ray>,
    ray_out: Vec<RayOut>,
    ray_gradient: Vec<[f32; 2]>,
    ray_loss: Vec<[f32; 4]>,
    tv_parts: Vec<f32>,
    gradient: Vec<f32>,
    /// Live samples, where one chunk holds all.
    samples: Option<Vec<Sample>>,
}

/// A live sample of the device.
pub(super) struct Sample {
    /// Index of its ray in the batch.
    pub(super) ray: usize,
    pub(super) x: DVec3,
    pub(super) path_length: f64,
    pub(super) near: bool,
    pub(super) sigma: [f32; 2],
}

impl DeviceResults {
    fn download(gpu: &Gpu, fit: &FieldsFit, loss: StepLoss) -> Result<DeviceResults> {
        let (forward, training, plan) = (fit.forward(), fit.training(), fit.data());
        let n = plan.setup.n_rays as usize;
        let one_chunk = chunks(&plan.setup, plan.setup.n_rays).count() == 1;
        Ok(DeviceResults {
            loss,
            rays: gpu.download(&forward.rays, 0, n)?,
            ray_out: gpu.download(&forward.ray_out, 0, n)?,
            ray_gradient: gpu.download(&training.ray_gradient, 0, n)?,
            ray_loss: gpu.download(&training.ray_loss, 0, n)?,
            tv_parts: gpu.download(&training.tv_parts, 0, tv_parts(&plan.params) as usize)?,
            gradient: gpu.download(&training.gradient, 0, plan.params.len)?,
            samples: one_chunk.then(|| samples(gpu, fit, loss.live_samples as usize)).transpose()?,
        })
    }

    fn total_variation(&self) -> f64 {
        self.tv_parts.iter().map(|part| f64::from(*part)).sum()
    }
}

/// The live samples of an iteration, which one chunk held.
pub(super) fn samples(gpu: &Gpu, fit: &FieldsFit, live: usize) -> Result<Vec<Sample>> {
    let (forward, capacity) = (fit.forward(), fit.data().setup.sample_capacity as usize);
    // A larger count would be a fault of the counter, which is compared anyway.
    let live = live.min(capacity);
    let points: Vec<[f32; 4]> = gpu.download(&forward.sample_points, 0, live)?;
    let rays: Vec<u32> = gpu.download(&forward.sample_rays, 0, live)?;
    let sigma: Vec<[f32; 2]> = gpu.download(&forward.sample_sigma, 0, live)?;
    let sample = |((point, ray), sigma): ((&[f32; 4], &u32), &[f32; 2])| {
        let [x, y, z, path_length] = point.map(f64::from);
        let (near, ray) = (ray & NEAR_SAMPLE != 0, (ray & !NEAR_SAMPLE) as usize);
        Sample { ray, x: DVec3::new(x, y, z), path_length, near, sigma: *sigma }
    };
    Ok(points.iter().zip(&rays).zip(&sigma).map(sample).collect())
}

/// Compares the stages of the first iterations of a case, on the path of `tuning`.
///
/// # Errors
/// Device errors; [`crate::error::Error::Config`] where the path is not for the device.
pub fn compare(gpu: &Gpu, dataset: &Dataset, case: &Case, tuning: &Tuning, findings: &mut Findings) -> Result<()> {
    findings.begin(path_name(tuning.layers), &case.name());
    let plan = case.plan(dataset)?;
    let mut params = plan.params.initial(plan.config.seed);
    if tuning.layers == Layers::F32 {
        // Larger planes and lines than the default start, so that static gradients are not tiny products.
        params[..plan.params.static_len].iter_mut().for_each(|p| *p *= 30.0);
    }
    let mut trainer = Trainer::new(gpu, plan, dataset, tuning.clone())?;
    gpu.upload(&trainer.fields()?.forward().params, 0, &params)?;
    let mut moments = vec![[0f32; 2]; params.len()];
    for _ in 0..ITERATIONS {
        compare_stages(gpu, &mut trainer, &params, tuning, findings)?;
        (params, moments) = compare_update(gpu, &trainer, &params, &moments, findings)?;
    }
    Ok(())
}

/// Number of compared iterations: the first, and one that starts from the state another has left.
pub(super) const ITERATIONS: usize = 2;

/// Runs an iteration, which begins with `params`, and compares its stages.
fn compare_stages(
    gpu: &Gpu,
    trainer: &mut Trainer,
    params: &[f32],
    tuning: &Tuning,
    findings: &mut Findings,
) -> Result<()> {
    let step = trainer.step();
    let loss = one_iteration(trainer)?;
    let seen = DeviceResults::download(gpu, trainer.fields()?, loss)?;
    let params: Vec<f64> = params.iter().map(|v| f64::from(*v)).collect();
    let precision = precision_of(trainer.fields()?);
    let plan = trainer.fields()?.data();
    let tolerances = Tolerances::of(precision, gpu.info());
    let network = plan.params.dynamic_network.as_ref();
    let computes_again = network.is_some_and(|network| computes_again(&tuning.matrices, network));
    let twin =
        Twin { plan, step, params: &params, rays: march::batch(plan, step), precision, tolerances, computes_again };
    twin.compare_rays(&seen, findings);
    if let Some(samples) = &seen.samples {
        twin.compare_samples(samples, &seen, findings);
        twin.compare_forward(samples, findings);
    }
    twin.compare_integrals(&seen, findings);
    twin.compare_loss(&seen, findings);
    twin.compare_total_variation(&seen, findings);
    twin.compare_static_gradient(&seen, findings);
    if let Some(samples) = &seen.samples {
        twin.compare_backward(samples, &seen, findings);
    }
    twin.compare_report(&seen, findings);
    twin.compare_whole(&seen, findings);
    Ok(())
}

/// Precision of the path that a run takes, for as long as its loss scale is the first.
pub(super) fn precision_of(fit: &FieldsFit) -> Precision {
    let of_two = fit.data().params.static_network.is_some();
    match fit.device_tuning().layers {
        Layers::F32 => Precision::Exact,
        Layers::Matrices if of_two => Precision::F16 { loss_scale: FIRST_LOSS_SCALE_OF_TWO.into() },
        Layers::Matrices => Precision::F16 { loss_scale: FIRST_LOSS_SCALE.into() },
    }
}

/// Name of a path in the rows.
pub fn path_name(layers: Layers) -> &'static str {
    layers.name()
}

pub(super) fn one_iteration(trainer: &mut Trainer) -> Result<StepLoss> {
    let next = trainer.step() + 1;
    Ok(told(trainer.advance(next))?.last().copied().unwrap_or(UNTOLD))
}

/// Losses of an iteration that reported none.
const UNTOLD: StepLoss = StepLoss {
    step: 0,
    data: f64::NAN,
    dynamic: f64::NAN,
    tv: f64::NAN,
    occlusion: f64::NAN,
    squared_error: f64::NAN,
    live_samples: 0,
    loss_scale: f64::NAN,
    networks: Some(NetworkLosses {
        favour_static: f64::NAN,
        ray_entropy: f64::NAN,
        static_size: f64::NAN,
        stopped: false,
    }),
};

impl Tolerances {
    /// Tolerances of a path on a device.
    pub(super) fn of(precision: Precision, info: &DeviceInfo) -> Tolerances {
        let exact = match precision {
            Precision::Exact => IN_F32,
            Precision::F16 { .. } => ON_MATRICES,
        };
        let sine = sine_factor(info);
        let Tolerances { sigma, gradient, loss } = exact;
        let gradient = gradient.times(sine);
        // The kinks of the cases are known to stay uncrossed by the rounding of llvmpipe only.
        let gradient = if info.is_llvmpipe { gradient } else { gradient.at_least(CROSSED_KINKS) };
        Tolerances { sigma: sigma.times(sine), gradient, loss: loss * sine }
    }
}

/// Factor on the network's tolerances on a device. Vulkan allows sine and cosine an error of 2^-11, which CPU drivers stay far
/// below. Faults are far larger than that.
pub fn sine_factor(info: &DeviceInfo) -> f64 {
    if info.is_cpu() { 1.0 } else { 10.0 }
}

impl Twin<'_> {
    fn on_matrices(&self) -> bool {
        self.precision != Precision::Exact
    }

    /// Stages that compute the gradient of the output neuron, of layers and of latents.
    fn backward_stages(&self) -> [&'static [&'static str]; 3] {
        if !self.on_matrices() {
            return [OUTPUT_BACKWARD, LAYERS_BACKWARD, LATENTS_BACKWARD];
        }
        let backward = if self.computes_again { BACKWARD_AGAIN_ON_MATRICES } else { BACKWARD_ON_MATRICES };
        [backward, backward, LATENTS_BACKWARD_ON_MATRICES]
    }

    fn compare_rays(&self, seen: &DeviceResults, findings: &mut Findings) {
        let mut worst = 0f64;
        for (got, want) in seen.rays.iter().zip(&self.rays) {
            let [(nearest, _), (beyond, share)] = want.shown;
            if (got.id, got.phase as usize, got.beyond as usize) != (want.id, nearest, beyond) {
                worst = f64::INFINITY;
            }
            worst = larger(worst, (f64::from(got.beyond_share) - share).abs());
            let off = |got: [f32; 3], want: DVec3| (DVec3::from_array(got.map(f64::from)) - want).abs().max_element();
            let bounds = [got.temporal_low, got.temporal_high];
            let bounds_off = bounds.iter().zip(want.temporal).map(|(got, want)| (f64::from(*got) - want).abs());
            let places_off = [off(got.anchor, want.anchor), off(got.direction, want.direction)];
            worst = bounds_off.chain(places_off).fold(worst, larger);
        }
        findings.add(RAYS, "rays", worst, POSITION);
    }

    /// Compares the number of live samples and, where both have as many on a ray, their places.
    fn compare_samples(&self, samples: &[Sample], seen: &DeviceResults, findings: &mut Findings) {
        let s = &self.plan.setup;
        let (mut strays, mut worst) = (0, 0f64);
        for (r, ray) in self.rays.iter().enumerate() {
            let depths = march::depths(s, s.n_dynamic_samples, s.dynamic_near, s.dynamic_far, self.step, ray);
            let want: Vec<(DVec3, f64)> = depths
                .into_iter()
                .map(|(depth, path_length)| (ray.anchor + depth * ray.direction, path_length))
                .filter(|(x, _)| march::searched(self.plan, *x, ray, |_| true))
                .collect();
            let got: Vec<&Sample> = samples.iter().filter(|sample| sample.ray == r).collect();
            strays += got.len().abs_diff(want.len());
            if got.len() == want.len() {
                for (got, (x, path_length)) in got.iter().zip(&want) {
                    worst = larger(worst, (got.x - *x).abs().max_element());
                    worst = larger(worst, (got.path_length - path_length).abs());
                }
            }
        }
        strays += samples.iter().filter(|sample| sample.ray >= self.rays.len()).count();
        strays += samples.len().abs_diff(seen.loss.live_samples as usize);
        findings.add(SAMPLES, "difference of the number of live samples", strays as f64, STRAY_SAMPLES);
        findings.add(SAMPLES, "places of samples", worst, POSITION);
    }

    fn trace(&self, sample: &Sample) -> field::NetworkTrace {
        let (plan, shown) = (self.plan, self.shown(sample));
        let encoded = field::encode(&plan.setup, plan.schedule[self.step as usize].window.into(), sample.x);
        let network = plan.params.dynamic_network.as_ref();
        let trace = |map| field::network_fwd(map, self.params, &encoded, shown, self.precision);
        network.map(trace).unwrap_or_default()
    }

    fn shown(&self, sample: &Sample) -> ShownPhases {
        self.rays.get(sample.ray).map_or([(0, 1.0), (0, 0.0)], |ray| ray.shown)
    }

    /// Compares attenuation and its slope at the device's samples.
    fn compare_forward(&self, samples: &[Sample], findings: &mut Findings) {
        let s = &self.plan.setup;
        let (gain, shift) = (f64::from(s.dynamic_gain), f64::from(s.dynamic_shift));
        let features: Vec<f64> = samples.iter().map(|sample| self.trace(sample).feature + shift).collect();
        let sigma: Vec<f64> = features.iter().map(|x| gain * field::softplus(*x)).collect();
        let slopes: Vec<f64> = features.iter().map(|x| gain * field::sigmoid(*x)).collect();
        let got = |k: usize| samples.iter().map(|sample| sample.sigma[k]).collect::<Vec<f32>>();
        let stages = if self.on_matrices() { FORWARD_ON_MATRICES } else { FORWARD };
        let tolerance = self.tolerances.sigma;
        findings.numbers(stages, "sample_sigma", &got(0), &sigma, tolerance);
        findings.numbers(stages, "slope of sample_sigma", &got(1), &slopes, tolerance);
    }

    /// Compares integrals of the device's samples, and of the twin's static field.
    fn compare_integrals(&self, seen: &DeviceResults, findings: &mut Findings) {
        let statics = |r: usize| self.march_statics(r).static_integral;
        let want: Vec<f64> = (0..self.rays.len()).map(statics).collect();
        let got: Vec<f32> = seen.ray_out.iter().map(|out| out.static_integral).collect();
        findings.numbers(LOSS, "static integral", &got, &want, F32_SUMS);
        let Some(samples) = &seen.samples else { return };
        let (mut dynamics, mut near) = (vec![0.0; self.rays.len()], vec![0.0; self.rays.len()]);
        for sample in samples.iter().filter(|sample| sample.ray < self.rays.len()) {
            let part = f64::from(sample.sigma[0]) * sample.path_length;
            dynamics[sample.ray] += part;
            near[sample.ray] += if sample.near { part } else { 0.0 };
        }
        let got: Vec<f32> = seen.ray_out.iter().map(|out| out.dynamic_integral).collect();
        findings.numbers(LOSS, "dynamic integral", &got, &dynamics, F32_SUMS);
        if self.plan.setup.occlusion_weight > 0.0 {
            let got: Vec<f32> = seen.ray_out.iter().map(|out| out.occlusion).collect();
            findings.numbers(LOSS, "occlusion", &got, &near, F32_SUMS);
        }
    }

    /// The static field along a ray, unless it is left out there.
    fn march_statics(&self, r: usize) -> march::March {
        march::statics(self.plan, self.params, self.step, &self.rays[r], !step::skips_static(self.plan, r))
    }

    /// Compares losses and their gradient, from the device's integrals.
    fn compare_loss(&self, seen: &DeviceResults, findings: &mut Findings) {
        let n = self.rays.len();
        let loss = |(r, out): (usize, &RayOut)| {
            let integrals = [out.static_integral, out.dynamic_integral].map(f64::from);
            step::ray_loss(self.plan, r, n, &self.rays[r], integrals)
        };
        let want: Vec<step::RayLoss> = seen.ray_out.iter().enumerate().map(loss).collect();
        for (k, name) in ["dL/dS", "dL/dD"].into_iter().enumerate() {
            let got: Vec<f32> = seen.ray_gradient.iter().map(|g| g[k]).collect();
            findings.numbers(LOSS, name, &got, &want.iter().map(|l| l.gradient[k]).collect::<Vec<_>>(), F32_SUMS);
        }
        let got = |k: usize| seen.ray_loss.iter().map(|l| l[k]).collect::<Vec<f32>>();
        findings.numbers(LOSS, "data terms", &got(0), &want.iter().map(|l| l.data).collect::<Vec<_>>(), F32_SUMS);
        let dynamic: Vec<f64> = want.iter().map(|l| l.dynamic).collect();
        findings.numbers(LOSS, "dynamic data terms", &got(1), &dynamic, F32_SUMS);
    }

    fn compare_total_variation(&self, seen: &DeviceResults, findings: &mut Findings) {
        let value = step::total_variation(self.plan, self.params, &mut vec![0.0; self.plan.params.len]);
        findings.add(TOTAL_VARIATION, "value", relative(seen.total_variation(), value), IN_F32.loss);
    }

    /// Compares the gradient of the static field, from the device's ray gradients and the total variation.
    fn compare_static_gradient(&self, seen: &DeviceResults, findings: &mut Findings) {
        let params = &self.plan.params;
        let mut want = vec![0.0; params.len];
        for (r, ray) in self.rays.iter().enumerate() {
            let by_integrals = [f64::from(seen.ray_gradient[r][0]), 0.0];
            let statics = self.march_statics(r);
            march::bwd(self.plan, self.params, ray, &statics, by_integrals, self.precision, &mut want);
        }
        step::total_variation(self.plan, self.params, &mut want);
        for tensor in params.tensors().iter().filter(|tensor| is_static(tensor)) {
            let (got, want) = (pick(&tensor.positions, &seen.gradient), pick(&tensor.positions, &want));
            findings.numbers(STATIC_GRADIENT, &tensor.name, &got, &want, F32_SUMS);
        }
    }

    /// Compares the gradient of the network, from the device's samples and ray gradients.
    fn compare_backward(&self, samples: &[Sample], seen: &DeviceResults, findings: &mut Findings) {
        let params = &self.plan.params;
        let mut want = vec![0.0; params.len];
        for sample in samples.iter().filter(|sample| sample.ray < self.rays.len()) {
            let by_integral = seen.ray_gradient[sample.ray][1].into();
            let Sample { x, path_length: dl, near, .. } = *sample;
            let trace = march::DynamicSample { x, dl, near, trace: self.trace(sample) };
            let shown = self.shown(sample);
            march::sample_bwd(self.plan, self.params, shown, &trace, by_integral, self.precision, &mut want);
        }
        for GradientPart { stages, name, positions } in parts(params, self.backward_stages()) {
            let (got, want) = (pick(&positions, &seen.gradient), pick(&positions, &want));
            findings.numbers(stages, &name, &got, &want, self.tolerances.gradient);
        }
    }

    /// Compares sums over the results of the device's rays.
    fn compare_report(&self, seen: &DeviceResults, findings: &mut Findings) {
        let sum = |k: usize| seen.ray_loss.iter().map(|loss| f64::from(loss[k])).sum::<f64>();
        let occlusion = f64::from(self.plan.setup.occlusion_weight) * sum(2);
        let loss = &seen.loss;
        for (name, got, want) in [
            ("data", loss.data, sum(0)),
            ("dynamic data", loss.dynamic, sum(1)),
            ("total variation", loss.tv, seen.total_variation()),
            ("occlusion", loss.occlusion, occlusion),
            ("squared error", loss.squared_error, sum(3)),
        ] {
            findings.add(REPORT, name, relative(got, want), IN_F32.loss);
        }
    }

    /// Compares losses and gradients with those that the twin computes by itself.
    fn compare_whole(&self, seen: &DeviceResults, findings: &mut Findings) {
        let whole = |precision| step::loss_and_gradient(self.plan, self.params, self.step, &self.rays, precision);
        let (want, gradient) = whole(self.precision);
        let (loss, tolerance) = (&seen.loss, self.tolerances.loss);
        for (name, got, want) in [
            ("data", loss.data, want.data),
            ("dynamic data", loss.dynamic, want.dynamic),
            ("total variation", loss.tv, want.tv),
            ("occlusion", loss.occlusion, want.occlusion),
        ] {
            findings.add(WHOLE, name, relative(got, want), tolerance);
        }
        // Tensor by tensor, so that a missing small gradient cannot hide behind a large one.
        for tensor in self.plan.params.tensors() {
            let (got, want) = (pick(&tensor.positions, &seen.gradient), pick(&tensor.positions, &gradient));
            findings.numbers(WHOLE, &tensor.name, &got, &want, self.tolerances.gradient);
        }
        if self.on_matrices() {
            let exact = whole(Precision::Exact).1;
            findings.numbers(F16_BESIDE_F64, "gradient", &seen.gradient, &exact, F16_COST);
        }
    }
}

/// A part of the network's gradient, and the stages that compute it.
struct GradientPart {
    stages: &'static [&'static str],
    name: String,
    positions: Vec<u32>,
}

/// Splits the network's gradient by the stages that compute it: the columns of latents are apart from the weights beside them.
fn parts(params: &ParamMap, [output, layers, latents]: [&'static [&'static str]; 3]) -> Vec<GradientPart> {
    let Some(network) = &params.dynamic_network else { return Vec::new() };
    let mut parts = Vec::new();
    let mut last = Vec::new();
    for tensor in params.tensors().into_iter().filter(|tensor| !is_static(tensor)) {
        let layer = layer_of(&tensor).map(|i| &network.layers[i]);
        let sees_input = layer.is_some_and(|layer| layer.latent.is_some());
        let part = |stages, name: String, positions| GradientPart { stages, name, positions };
        match tensor.name.as_str() {
            name if name.starts_with("dynamic.out") => parts.push(part(output, tensor.name, tensor.positions)),
            name if name.ends_with(".weight") => {
                let (columns, latent) = (tensor.shape[1], network.encoded_len..network.encoded_len + network.latent);
                let of_latent = |at: usize| sees_input && latent.contains(&(at % columns));
                let (mut of_latents, mut of_weights) = (Vec::new(), Vec::new());
                for (at, position) in tensor.positions.into_iter().enumerate() {
                    if of_latent(at) { of_latents.push(position) } else { of_weights.push(position) }
                }
                parts.push(part(layers, tensor.name.clone(), of_weights));
                if sees_input {
                    last.push(part(latents, format!("{} on the latent vector", tensor.name), of_latents));
                }
            }
            // Biases of layers without latents are summed with the weights; the others come from the sums per phase.
            name if name.ends_with(".bias") && !sees_input => {
                parts.push(part(layers, tensor.name, tensor.positions));
            }
            _ => last.push(part(latents, tensor.name, tensor.positions)),
        }
    }
    // In the order in which the stages run.
    parts.sort_by_key(|part| part.stages != output);
    parts.into_iter().chain(last).collect()
}

fn layer_of(tensor: &Tensor) -> Option<usize> {
    tensor.name.strip_prefix("dynamic.layer")?.split('.').next()?.parse().ok()
}

fn is_static(tensor: &Tensor) -> bool {
    tensor.name.starts_with("static")
}

pub(super) fn pick<T: Copy>(positions: &[u32], all: &[T]) -> Vec<T> {
    positions.iter().map(|at| all[*at as usize]).collect()
}

/// Losses below this count as zero.
const NO_LOSS: f64 = 1e-12;

/// Relative difference of losses.
pub(super) fn relative(got: f64, want: f64) -> f64 {
    let difference = (got - want).abs();
    if difference <= NO_LOSS { 0.0 } else { difference / want.abs() }
}

/// The larger of two deviations; NaN is larger than any.
fn larger(a: f64, b: f64) -> f64 {
    if a.is_nan() || b.is_nan() { f64::INFINITY } else { a.max(b) }
}

/// Compares the optimiser on the device's gradient: parameters and moments after it.
pub(super) fn compare_update(
    gpu: &Gpu,
    trainer: &Trainer,
    params: &[f32],
    moments: &[[f32; 2]],
    findings: &mut Findings,
) -> Result<(Vec<f32>, Vec<[f32; 2]>)> {
    let (plan, n) = (trainer.fields()?.data(), params.len());
    let gradient: Vec<f32> = gpu.download(&trainer.fields()?.training().gradient, 0, n)?;
    let after: Vec<f32> = gpu.download(&trainer.fields()?.forward().params, 0, n)?;
    let moments_after: Vec<[f32; 2]> = gpu.download(&trainer.fields()?.training().moments, 0, n)?;
    let mut want: Vec<f64> = params.iter().map(|v| f64::from(*v)).collect();
    let mut want_moments: Vec<[f64; 2]> = moments.iter().map(|m| m.map(f64::from)).collect();
    let gradient: Vec<f64> = gradient.iter().map(|v| f64::from(*v)).collect();
    step::adam(plan, trainer.step() - 1, &gradient, &mut want, &mut want_moments);
    for (name, range) in [("static", 0..plan.params.static_len), ("dynamic", plan.params.static_len..n)] {
        let got: Vec<f32> = range.clone().map(|i| (f64::from(after[i]) - f64::from(params[i])) as f32).collect();
        let want: Vec<f64> = range.map(|i| want[i] - f64::from(params[i])).collect();
        findings.numbers(ADAM, &format!("update of {name} parameters"), &got, &want, UPDATE);
    }
    for (k, name) in ["first moments", "second moments"].into_iter().enumerate() {
        let got: Vec<f32> = moments_after.iter().map(|m| m[k]).collect();
        let want: Vec<f64> = want_moments.iter().map(|m| m[k]).collect();
        findings.numbers(ADAM, name, &got, &want, F32_SUMS);
    }
    Ok((after, moments_after))
}
