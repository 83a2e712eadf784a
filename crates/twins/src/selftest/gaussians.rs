//! Gaussians, a set per phase: an iteration of their fit, stage by stage, and the optimiser over ten.

use crate::error::Result;
use crate::gaussians::particles::{ParticleBuffers, Particles};
use crate::gaussians::stages::TargetBuffers;
use crate::gpu::device::Gpu;
use crate::kernels::layout::{GaussianSetup, Splat};
use crate::kernels::push::{self, PushConstants};
use crate::methods::dynamic_gaussians::per_phase::GaussianTrainer;
use crate::methods::dynamic_gaussians::setup;
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::reference::gaussians::{self as reference, N_PARAMS, Params, Projection, params};
use crate::selftest::compare::{Findings, Tolerance, told};
use crate::selftest::problems::{default_rules, hard_case};

const PROJECT: &[&str] = &[push::GaussianProject::SHADER];
pub(crate) const SPLAT: &[&str] = &[push::GaussianSplat::SHADER];
const UPDATE: &[&str] = &[push::GaussianUpdate::SHADER];
pub(crate) const REPORT: &[&str] = &[push::GaussianReport::SHADER];
const RESIDUAL: &[&str] = &[push::GaussianResidual::SHADER];
const MOMENTS: &[&str] = &[push::GaussianMoments::SHADER];

/// f32 positions, and sums in steps of 1e-6.
pub(crate) const NUMBERS: Tolerance = Tolerance::OfLargest(1e-4);
/// Pixels, or shares of a splat's own size: f32 positions some hundred pixels from the source.
const SPLAT_ERROR: f64 = 1e-3;
/// Losses are sums of many pixels.
pub(crate) const LOSS: f64 = 2e-5;
/// Parameters that may differ by more than [`FAR`] after ten updates: Adam divides by the gradient's size, so a tiny
/// gradient's rounding shows in full.
const FAR_SHARE: f64 = 0.01;
const FAR: f64 = 1e-3;

/// The parts of a Gaussian's parameters.
pub const TENSORS: [(&str, std::ops::Range<usize>); 4] =
    [("position", 0..3), ("density", 3..4), ("scale", 4..7), ("rotation", 7..11)];

/// Images of Gaussians, each of a phase, by the twin.
pub fn twin_images(targets: &Targets, setup: &GaussianSetup, all: &[(Params, usize)]) -> Vec<f64> {
    let n = targets.n_pixels();
    let mut images = vec![0.0; targets.n_images * n];
    for (p, phase) in all {
        for (image, view) in targets.views_at(*phase) {
            if let Some(seen) = reference::project(p, view, setup) {
                seen.splat(setup, &mut images[image * n..][..n]);
            }
        }
    }
    images
}

/// Loss of images, and its gradient by each of their pixels, by the twin.
pub fn twin_residuals(targets: &Targets, setup: &GaussianSetup, images: &[f64]) -> (f64, Vec<Vec<f64>>) {
    let n = targets.n_pixels();
    let mut loss = 0.0;
    let mut gradients = Vec::new();
    for (i, image) in images.chunks(n).enumerate() {
        let part = |all: &'_ [f32]| all[i * n..][..n].to_vec();
        let (value, gradient) =
            reference::residual(setup, image, &part(&targets.low), &part(&targets.high), targets.weight.image(i));
        loss += value;
        gradients.push(gradient);
    }
    (loss, gradients)
}

/// Images, loss and gradient of Gaussians, each of a phase, by the twins.
pub fn twin(targets: &Targets, setup: &GaussianSetup, all: &[(Params, usize)]) -> (Vec<f64>, f64, Vec<Params>) {
    let images = twin_images(targets, setup, all);
    let (loss, gradients) = twin_residuals(targets, setup, &images);
    let gradient = |(p, phase): &(Params, usize)| {
        let mut sum = [0.0; N_PARAMS];
        for (image, view) in targets.views_at(*phase) {
            let Some(seen) = reference::project(p, view, setup) else { continue };
            let one = reference::gradient(p, view, setup, seen.moments(setup, &gradients[image]));
            sum.iter_mut().zip(one).for_each(|(sum, g)| *sum += g);
        }
        sum
    };
    (images, loss, all.iter().map(gradient).collect())
}

/// One part of all parameters, one Gaussian after the other.
pub fn numbers(all: &[Params], range: std::ops::Range<usize>) -> Vec<f64> {
    all.iter().flat_map(|p| p[range.clone()].to_vec()).collect()
}

/// Parameters as the device lays out gradients and moments: position and density, scale and nothing, rotation.
pub fn of_rows(rows: &[[f32; 12]]) -> Vec<Params> {
    rows.iter().map(|r| [0, 1, 2, 3, 4, 5, 6, 8, 9, 10, 11].map(|k| f64::from(r[k]))).collect()
}

/// The gradient on the device.
///
/// # Errors
/// Device errors.
pub fn device_gradient(gpu: &Gpu, particles: &ParticleBuffers, n: usize) -> Result<Vec<Params>> {
    Ok(of_rows(&gpu.download(&particles.gaussian_gradient, 0, n)?))
}

pub(crate) fn f32s(values: &[f64]) -> Vec<f32> {
    values.iter().map(|v| *v as f32).collect()
}

/// Distance of a splat from the twin's: in pixels, or as a share of its own size.
fn splat_error(got: &Splat, want: &Projection) -> f64 {
    let conic = [want.conic.x_axis.x, want.conic.x_axis.y, want.conic.y_axis.y];
    let largest = conic.iter().fold(0f64, |max, c| max.max(c.abs()));
    let axis = |k: usize| {
        let half_box = (f64::from(got.half_box[k]) - want.half_box[k]).abs() / want.half_box[k];
        [(f64::from(got.mean[k]) - want.mean[k]).abs(), half_box]
    };
    let amplitude = (f64::from(got.amplitude) / want.amplitude - 1.0).abs();
    let conic = got.conic.iter().zip(conic).map(|(got, want)| (f64::from(*got) - want).abs() / largest);
    let all = axis(0).into_iter().chain(axis(1)).chain(conic).chain([amplitude]);
    all.fold(0.0, |worst, error| if error.is_nan() { f64::INFINITY } else { worst.max(error) })
}

/// Compares splats, each of a Gaussian in a view: size and place where the twin sees something of it; elsewhere the box must be
/// empty. `seen` returns the twin's splat at an index, and the image it belongs to.
pub(crate) fn compare_splats(
    gpu: &Gpu,
    particles: &ParticleBuffers,
    setup: &GaussianSetup,
    stages: &[&'static str],
    seen: &[TwinSplat],
    findings: &mut Findings,
) -> Result<()> {
    let splats: Vec<Splat> = gpu.download(&particles.splats, 0, seen.len())?;
    let images: Vec<i32> = gpu.download(&particles.image_of_splat, 0, seen.len())?;
    let (mut worst, mut visible) = (0f64, 0);
    for ((splat, image), seen) in splats.iter().zip(&images).zip(seen) {
        let image_of_twin = seen.as_ref().map_or(-1, |(image, _)| *image as i32);
        if *image != image_of_twin {
            worst = f64::INFINITY;
        }
        let Some((_, projection)) = seen else { continue };
        match projection.as_ref().filter(|p| p.pixels(setup).next().is_some()) {
            Some(projection) => {
                visible += 1;
                worst = worst.max(splat_error(splat, projection));
            }
            // Behind the source.
            None if projection.is_none() && splat.half_box[0] >= 0.0 => worst = f64::INFINITY,
            None => {}
        }
    }
    findings.add(stages, "splats", worst, SPLAT_ERROR);
    findings.require(stages, "splats in the images", visible * 10 > seen.len());
    Ok(())
}

/// A splat as the twin sees it, and the image it belongs to; none where a view lacks the phase.
pub(crate) type TwinSplat = Option<(usize, Option<Projection>)>;

/// Compares residuals with those of the device's own images, and moments with those of the device's own residuals; returns the
/// twin's loss of the images, and the device's moments.
pub(crate) fn compare_backward(
    gpu: &Gpu,
    (targets, setup): (&Targets, &GaussianSetup),
    (buffers, particles): (&TargetBuffers, &ParticleBuffers),
    images: &[f32],
    seen: &[TwinSplat],
    findings: &mut Findings,
) -> Result<(f64, Vec<[f64; 6]>)> {
    let (n, stride) = (targets.n_pixels(), setup.image_stride as usize);
    let images: Vec<f64> = images.iter().map(|v| f64::from(*v)).collect();
    let (loss, want) = twin_residuals(targets, setup, &images);
    let got: Vec<f32> = gpu.download(&buffers.splat_image_gradient, 0, targets.n_images * stride)?;
    let pixels: Vec<f32> = got.chunks(stride).flat_map(|image| image[..n].to_vec()).collect();
    findings.numbers(RESIDUAL, "gradient of the images", &pixels, &want.concat(), NUMBERS);
    let image_gradient: Vec<Vec<f64>> =
        pixels.chunks(n).map(|image| image.iter().map(|v| f64::from(*v)).collect()).collect();
    let left: Vec<i32> = gpu.download(&buffers.splat_images, 0, targets.n_images * stride)?;
    findings.require(RESIDUAL, "sums cleared for the next iteration", left.iter().all(|sum| *sum == 0));
    let rows: Vec<[f32; 8]> = gpu.download(&particles.splat_moments, 0, seen.len())?;
    let of_splats: Vec<[f32; 6]> = rows.iter().map(|r| [0, 1, 2, 4, 5, 6].map(|k| r[k])).collect();
    let want = |seen: &TwinSplat| match seen {
        Some((image, Some(projection))) => projection.moments(setup, &image_gradient[*image]),
        _ => [0.0; 6],
    };
    let want: Vec<[f64; 6]> = seen.iter().map(want).collect();
    for (range, name) in [(0..1, "sums of h"), (1..3, "sums of h d"), (3..6, "sums of h d d")] {
        let got: Vec<f32> = of_splats.iter().flat_map(|m| m[range.clone()].to_vec()).collect();
        let want: Vec<f64> = want.iter().flat_map(|m| m[range.clone()].to_vec()).collect();
        findings.numbers(MOMENTS, name, &got, &want, NUMBERS);
    }
    Ok((loss, of_splats.iter().map(|m| m.map(f64::from)).collect()))
}

/// Compares the stages of an iteration, and the parameters after ten.
///
/// # Errors
/// Device errors.
pub fn compare(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    findings.begin("phase", "77 Gaussians, 8 images of 33 x 27 pixels");
    let (targets, rows) = hard_case()?;
    let preset = default_rules()?;
    let mut trainer = GaussianTrainer::with(gpu, targets.clone(), &preset, &Particles::fresh(rows.clone()))?;
    let setup = *trainer.setup();
    let all: Vec<(Params, usize)> = rows.iter().map(|g| (params(g), g.phase as usize)).collect();
    let images = trainer.images()?;
    let seen: Vec<TwinSplat> = (0..targets.n_views)
        .flat_map(|view| all.iter().map(move |(p, phase)| (view, p, *phase)))
        .map(|(view, p, phase)| {
            let image = targets.image_of[phase * targets.n_views + view]?;
            Some((image, reference::project(p, &targets.views[image], &setup)))
        })
        .collect();
    compare_splats(gpu, trainer.particles(), &setup, PROJECT, &seen, findings)?;
    findings.numbers(SPLAT, "images", &images, &twin_images(&targets, &setup, &all), NUMBERS);
    let loss = told(trainer.advance(1))?.first().copied().unwrap_or(f64::NAN);
    let buffers = (trainer.target_buffers(), trainer.particles());
    let (twin_loss, moments) = compare_backward(gpu, (&targets, &setup), buffers, &images, &seen, findings)?;
    // Gradients of the parameters by the device's moments.
    let gradient = |i: usize| {
        let mut sum = [0.0; N_PARAMS];
        for view in 0..targets.n_views {
            let at = view * all.len() + i;
            if let Some((image, Some(_))) = &seen[at] {
                let one = reference::gradient(&all[i].0, &targets.views[*image], &setup, moments[at]);
                sum.iter_mut().zip(one).for_each(|(sum, g)| *sum += g);
            }
        }
        sum
    };
    let want: Vec<Params> = (0..all.len()).map(gradient).collect();
    compare_gradient(&device_gradient(gpu, trainer.particles(), all.len())?, &want, UPDATE, findings);
    findings.add(REPORT, "loss", (loss / twin_loss - 1.0).abs(), LOSS);
    drop(trainer);
    compare_ten_updates(gpu, findings)
}

/// Part by part, so that a missing small gradient cannot hide behind a large one.
pub(crate) fn compare_gradient(got: &[Params], want: &[Params], stages: &[&'static str], findings: &mut Findings) {
    for (name, range) in TENSORS {
        let got = f32s(&numbers(got, range.clone()));
        findings.numbers(stages, &format!("gradient of {name}"), &got, &numbers(want, range), NUMBERS);
    }
}

fn compare_ten_updates(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    findings.begin("phase", "77 Gaussians, ten updates");
    let (targets, rows) = hard_case()?;
    let mut config = default_rules()?;
    config.gaussians.iterations = 12;
    let mut trainer = GaussianTrainer::with(gpu, targets.clone(), &config, &Particles::fresh(rows.clone()))?;
    while trainer.step() < 10 {
        trainer.advance(10)?;
    }
    let setup = *trainer.setup();
    let mut all: Vec<(Params, usize)> = rows.iter().map(|g| (params(g), g.phase as usize)).collect();
    let mut moments = vec![[[0.0; 2]; N_PARAMS]; all.len()];
    for row in &setup::schedule(&config.gaussians)[..10] {
        let (_, _, gradient) = twin(&targets, &setup, &all);
        for (((p, _), g), moments) in all.iter_mut().zip(&gradient).zip(&mut moments) {
            reference::adam(&setup, row, g, p, moments);
        }
    }
    let (mut far, mut moved) = (0, 0);
    for ((want, _), (got, start)) in all.iter().zip(trainer.model()?.rows.iter().zip(&rows)) {
        let (got, start) = (params(got), params(start));
        for k in 0..N_PARAMS {
            far += usize::from((got[k] - want[k]).abs() > FAR);
            moved += usize::from((got[k] - start[k]).abs() > 0.05);
        }
    }
    let n = (all.len() * N_PARAMS) as f64;
    findings.add(UPDATE, "share of parameters that differ", far as f64 / n, FAR_SHARE);
    findings.require(UPDATE, "parameters that change", moved as f64 > 0.5 * n);
    Ok(())
}
