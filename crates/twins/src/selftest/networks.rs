//! One iteration of two networks as the fields, stage by stage, as [`super::iteration`] does of the others.

use crate::error::{Error, Result};
use crate::fields::trainer::FieldsFit;
use crate::fitting::losses::{NetworkLosses, StepLoss};
use crate::gpu::device::Gpu;
use crate::kernels::layout::{Ray, RayOut};
use crate::kernels::push::{self, PushConstants};
use crate::kernels::tuning::Tuning;
use crate::network::static_network::StaticNetwork;
use crate::reference::field::{NetworkTrace, Precision};
use crate::reference::march;
use crate::reference::networks::{self, PairLoss, PairSample, SamplePlace};
use crate::reference::step;
use crate::scan::dataset::Dataset;
use crate::selftest::compare::Findings;
use crate::selftest::iteration::{
    Case, F32_SUMS, ITERATIONS, Sample, Tolerances, compare_update, one_iteration, path_name, pick, precision_of,
    relative, samples,
};
use crate::selftest::problems::TWO_NETWORKS;
use crate::train::trainer::Trainer;

/// Settings with which each loss of two networks shows beside the others.
pub const LARGE: &[&str] = &[
    "networks.gain=0.5",
    "networks.delay=1",
    "networks.ramp=4",
    "networks.favour_static=0.05",
    "networks.favour_static_end=0.3",
    "networks.ray_entropy=0.02",
    "networks.ray_entropy_end=0.1",
    "networks.near_integral=0.01",
    "networks.near_integral_end=0.3",
    "networks.static_size=1e-3",
    "networks.static_size_end=1e-2",
];

/// Almost empty fields, whose entropy counts along some rays; the near part of rays; a skip layer.
const FAINT: &[&str] = &[
    "networks.gain=1e-5",
    "networks.favour_static_end=0.3",
    "networks.delay=0",
    "networks.ramp=1",
    // A larger weight would hide all else: scaling a field does not change its entropy, so the sums of that gradient nearly
    // cancel.
    "networks.ray_entropy=1e-3",
    "networks.ray_entropy_end=1e-3",
    "networks.near_integral=0.3",
    "dynamic.occlusion_share=0.3",
    "dynamic.layers=3",
    "dynamic.skip_layer=2",
    "march.along_axis=false",
];

/// Samples of several chunks, which leave whole iterations to compare.
const CHUNKS: &[&str] = &["networks.gain=0.5", "train.rays=70"];

/// Configurations that are compared.
pub const CASES: &[Case] = &[
    Case { preset: TWO_NETWORKS, settings: LARGE },
    Case { preset: TWO_NETWORKS, settings: FAINT },
    Case { preset: TWO_NETWORKS, settings: CHUNKS },
];

const RAYS: &[&str] = &[push::Batch::SHADER];
const FORWARD: &[&str] = &["both networks forward"];
const INTEGRALS: &[&str] = &[push::MarchFwdSamples::SHADER];
const LOSS: &[&str] = &[push::LossSamples::SHADER];
const BACKWARD: &[&str] = &["both networks backward"];
const REPORT: &[&str] = &[push::Report::SHADER];
const WHOLE: &[&str] = &["whole iteration of two networks"];

/// Tolerance of a pixel's change, which shaders and twin know as the same f32.
const CHANGE: f64 = 1e-7;

/// Results of an iteration on the device.
struct DeviceResults {
    loss: StepLoss,
    networks: NetworkLosses,
    rays: Vec<Ray>,
    ray_out: Vec<RayOut>,
    ray_loss: Vec<[f32; 4]>,
    regularisers: Vec<[f32; 4]>,
    gradient: Vec<f32>,
}

/// Live samples of the device.
struct Pairs {
    of_dynamic: Vec<Sample>,
    of_static: Vec<[f32; 2]>,
    /// Gradients of the attenuations of the static and of the dynamic field.
    gradient: [Vec<f32>; 2],
}

impl Pairs {
    fn download(gpu: &Gpu, fit: &FieldsFit, static_network: &StaticNetwork, loss: &StepLoss) -> Result<Pairs> {
        let of_dynamic = samples(gpu, fit, loss.live_samples as usize)?;
        let n = of_dynamic.len();
        let gradient = static_network
            .sigma_gradient()
            .ok_or_else(|| Error::Internal("the network was not created for training".into()))?;
        Ok(Pairs {
            of_static: gpu.download(static_network.sigma(), 0, n)?,
            gradient: [gpu.download(gradient, 0, n)?, gpu.download(&fit.training().sigma_gradient, 0, n)?],
            of_dynamic,
        })
    }

    /// Samples of a ray, and where they are among all.
    fn of_ray(&self, ray: usize) -> (Vec<usize>, Vec<PairSample>) {
        let own = (0..self.of_dynamic.len()).filter(|s| self.of_dynamic[*s].ray == ray);
        let pair = |s: usize| {
            let sample = &self.of_dynamic[s];
            let sigma = [self.of_static[s][0], sample.sigma[0]].map(f64::from);
            (s, PairSample { dl: sample.path_length, near: sample.near, sigma })
        };
        own.map(pair).unzip()
    }
}

/// The twin's side of a comparison.
struct Twin<'a> {
    fit: &'a FieldsFit,
    precision: Precision,
    step: u32,
    params: &'a [f64],
    rays: Vec<march::Ray>,
    tolerances: Tolerances,
}

/// Compares the stages of the first iterations of a case, on the path of `tuning`.
///
/// # Errors
/// Device errors; [`Error::Config`] where the path is not for the device.
pub fn compare(gpu: &Gpu, dataset: &Dataset, case: &Case, tuning: &Tuning, findings: &mut Findings) -> Result<()> {
    findings.begin(path_name(tuning.layers), &case.name());
    let mut trainer = Trainer::new(gpu, case.plan(dataset)?, dataset, tuning.clone())?;
    let mut params = trainer.fields()?.data().params.initial(trainer.plan().config.seed);
    let mut moments = vec![[0f32; 2]; params.len()];
    for _ in 0..ITERATIONS {
        let step = trainer.step();
        let loss = one_iteration(&mut trainer)?;
        let exact: Vec<f64> = params.iter().map(|v| f64::from(*v)).collect();
        let (fit, precision) = (trainer.fields()?, precision_of(trainer.fields()?));
        let tolerances = Tolerances::of(precision, gpu.info());
        let rays = march::batch(fit.data(), step);
        Twin { fit, precision, step, params: &exact, rays, tolerances }.compare(gpu, loss, findings)?;
        (params, moments) = compare_update(gpu, &trainer, &params, &moments, findings)?;
    }
    Ok(())
}

impl Twin<'_> {
    fn compare(&self, gpu: &Gpu, loss: StepLoss, findings: &mut Findings) -> Result<()> {
        let (forward, training, plan) = (self.fit.forward(), self.fit.training(), self.fit.data());
        let missing = || Error::Internal("the static field is not a network".into());
        let (static_network, networks) =
            (self.fit.static_network().ok_or_else(missing)?, loss.networks.ok_or_else(missing)?);
        let n = self.rays.len();
        let seen = DeviceResults {
            loss,
            networks,
            rays: gpu.download(&forward.rays, 0, n)?,
            ray_out: gpu.download(&forward.ray_out, 0, n)?,
            ray_loss: gpu.download(&training.ray_loss, 0, n)?,
            regularisers: gpu.download(&training.ray_regularisers, 0, n)?,
            gradient: gpu.download(&training.gradient, 0, plan.params.len)?,
        };
        let changes = seen.rays.iter().zip(&self.rays).map(|(got, want)| (f64::from(got.change) - want.change).abs());
        findings.add(RAYS, "changes of pixels", changes.fold(0.0, f64::max), CHANGE);
        if crate::network::chunk::chunks(&plan.setup, plan.setup.n_rays).count() == 1 {
            let pairs = Pairs::download(gpu, self.fit, static_network, &loss)?;
            let traces = self.traces(&pairs);
            self.compare_forward(&pairs, &traces, findings);
            self.compare_integrals(&pairs, &seen, findings);
            self.compare_losses(&pairs, &seen, findings);
            self.compare_backward(&pairs, &traces, &seen, findings);
        }
        self.compare_report(&seen, findings);
        self.compare_whole(&seen, findings);
        Ok(())
    }

    fn place(&self, sample: &Sample) -> SamplePlace {
        SamplePlace { x: sample.x, shown: self.rays[sample.ray].shown }
    }

    fn traces(&self, pairs: &Pairs) -> Vec<[NetworkTrace; 2]> {
        let (plan, precision) = (self.fit.data(), self.precision);
        let at = |sample: &Sample| networks::traces(plan, self.params, self.step, self.place(sample), precision);
        pairs.of_dynamic.iter().map(at).collect()
    }

    /// Compares attenuations and their slopes at the device's samples.
    fn compare_forward(&self, pairs: &Pairs, traces: &[[NetworkTrace; 2]], findings: &mut Findings) {
        let want: Vec<_> = traces.iter().map(|traces| networks::attenuations(self.fit.data(), traces)).collect();
        for (k, what) in ["attenuation", "slope"].into_iter().enumerate() {
            let of_dynamic: Vec<f32> = pairs.of_dynamic.iter().map(|sample| sample.sigma[k]).collect();
            let of_static: Vec<f32> = pairs.of_static.iter().map(|sigma| sigma[k]).collect();
            for (field, got) in [(0, of_static), (1, of_dynamic)] {
                let want: Vec<f64> = want.iter().map(|of| of[field][k]).collect();
                let name = format!("{what} of the {} field", ["static", "dynamic"][field]);
                findings.numbers(FORWARD, &name, &got, &want, self.tolerances.sigma);
            }
        }
    }

    /// Compares integrals of the device's samples.
    fn compare_integrals(&self, pairs: &Pairs, seen: &DeviceResults, findings: &mut Findings) {
        let want: Vec<_> = (0..self.rays.len()).map(|r| networks::integrals(&pairs.of_ray(r).1)).collect();
        let column =
            |name: &str, got: fn(&RayOut) -> f32, of: fn(&networks::PairIntegrals) -> f64, f: &mut Findings| {
                let got: Vec<f32> = seen.ray_out.iter().map(got).collect();
                f.numbers(INTEGRALS, name, &got, &want.iter().map(of).collect::<Vec<_>>(), F32_SUMS);
            };
        column("static integral", |out| out.static_integral, |w| w.fields[0], findings);
        column("dynamic integral", |out| out.dynamic_integral, |w| w.fields[1], findings);
        column("near integral", |out| out.occlusion, |w| w.near, findings);
    }

    /// Compares losses of the device's integrals and samples, and their gradient at each.
    fn compare_losses(&self, pairs: &Pairs, seen: &DeviceResults, findings: &mut Findings) {
        let (plan, n) = (self.fit.data(), self.rays.len());
        let mut gradient = [vec![0.0; pairs.of_dynamic.len()], vec![0.0; pairs.of_dynamic.len()]];
        let mut losses: Vec<PairLoss> = Vec::new();
        for (r, ray) in self.rays.iter().enumerate() {
            let (at, own) = pairs.of_ray(r);
            let fields = [seen.ray_out[r].static_integral, seen.ray_out[r].dynamic_integral].map(f64::from);
            let loss = networks::ray_loss(plan, self.step, n, ray, fields, &own);
            for (s, by_sigma) in at.iter().zip(&loss.gradient) {
                gradient.iter_mut().zip(by_sigma).for_each(|(all, value)| all[*s] = *value);
            }
            losses.push(loss);
        }
        for (field, name) in ["dL/d sigma_l", "dL/d sigma_s"].into_iter().enumerate() {
            findings.numbers(LOSS, name, &pairs.gradient[field], &gradient[field], F32_SUMS);
        }
        let column = |name: &str, got: Vec<f32>, of: fn(&PairLoss) -> f64, findings: &mut Findings| {
            findings.numbers(LOSS, name, &got, &losses.iter().map(of).collect::<Vec<_>>(), F32_SUMS);
        };
        let (loss, more) = (
            |k: usize| seen.ray_loss.iter().map(|l| l[k]).collect(),
            |k: usize| seen.regularisers.iter().map(|l| l[k]).collect(),
        );
        column("photometric", loss(0), |l| l.data, findings);
        column("near integral", loss(2), |l| l.near, findings);
        column("squared residual", loss(3), |l| l.squared_error, findings);
        column("favour static", more(0), |l| l.favour_static, findings);
        column("ray entropy", more(1), |l| l.ray_entropy, findings);
        column("static size", more(2), |l| l.static_size, findings);
    }

    /// Compares the gradient of both networks, from the device's gradients at samples.
    fn compare_backward(
        &self,
        pairs: &Pairs,
        traces: &[[NetworkTrace; 2]],
        seen: &DeviceResults,
        findings: &mut Findings,
    ) {
        let (plan, precision) = (self.fit.data(), self.precision);
        let mut want = vec![0.0; plan.params.len];
        for (s, (sample, traces)) in pairs.of_dynamic.iter().zip(traces).enumerate() {
            let by_sigma = [0, 1].map(|field| f64::from(pairs.gradient[field][s]));
            networks::sample_bwd(plan, self.params, self.place(sample), traces, by_sigma, precision, &mut want);
        }
        self.compare_tensors(BACKWARD, &want, seen, findings);
    }

    /// Compares tensor by tensor, so that a missing small gradient cannot hide behind a large one.
    fn compare_tensors(&self, stages: &[&'static str], want: &[f64], seen: &DeviceResults, findings: &mut Findings) {
        for tensor in self.fit.data().params.tensors() {
            let (got, want) = (pick(&tensor.positions, &seen.gradient), pick(&tensor.positions, want));
            findings.numbers(stages, &tensor.name, &got, &want, self.tolerances.gradient);
        }
    }

    /// Compares sums over the results of the device's rays.
    fn compare_report(&self, seen: &DeviceResults, findings: &mut Findings) {
        let row = self.fit.data().schedule[self.step as usize];
        let sum = |all: &[[f32; 4]], k: usize| all.iter().map(|loss| f64::from(loss[k])).sum::<f64>();
        let weighted = |weight: f32, k: usize| f64::from(weight) * sum(&seen.regularisers, k);
        for (name, got, want) in [
            ("data", seen.loss.data, sum(&seen.ray_loss, 0)),
            ("near integral", seen.loss.occlusion, f64::from(row.near_integral) * sum(&seen.ray_loss, 2)),
            ("squared error", seen.loss.squared_error, sum(&seen.ray_loss, 3)),
            ("favour static", seen.networks.favour_static, weighted(row.favour_static, 0)),
            ("ray entropy", seen.networks.ray_entropy, weighted(row.ray_entropy, 1)),
            ("static size", seen.networks.static_size, weighted(row.static_size, 2)),
        ] {
            findings.add(REPORT, name, relative(got, want), self.tolerances.loss);
        }
        findings.require(
            REPORT,
            "no total variation, and no end of learning",
            seen.loss.tv == 0.0 && !seen.networks.stopped,
        );
    }

    /// Compares losses and gradients with those that the twin computes by itself.
    fn compare_whole(&self, seen: &DeviceResults, findings: &mut Findings) {
        let (plan, precision) = (self.fit.data(), self.precision);
        let (want, gradient) = step::loss_and_gradient(plan, self.params, self.step, &self.rays, precision);
        for (name, got, want) in [
            ("objective", seen.loss.total(), want.total()),
            ("data", seen.loss.data, want.data),
            ("near integral", seen.loss.occlusion, want.occlusion),
            ("favour static", seen.networks.favour_static, want.favour_static),
            ("ray entropy", seen.networks.ray_entropy, want.ray_entropy),
            ("static size", seen.networks.static_size, want.static_size),
        ] {
            findings.add(WHOLE, name, relative(got, want), self.tolerances.loss);
        }
        self.compare_tensors(WHOLE, &gradient, seen, findings);
    }
}
