//! One set of Gaussians that moves over the beat: an iteration of its fit, stage by stage.

use crate::error::{Error, Result};
use crate::gaussians::particles::Particles;
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::Recording;
use crate::kernels::dispatch::{BufferSet, dispatch_finding};
use crate::kernels::layout::{Gaussian, GaussianSetup, MotionGridSetup};
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage};
use crate::methods::dynamic_gaussians::deformable::DeformableTrainer;
use crate::methods::dynamic_gaussians::deformable::filling::{FILLING_RATE, MIN_FILLING};
use crate::methods::dynamic_gaussians::per_phase::GaussianTrainer;
use crate::methods::dynamic_gaussians::rules::{GaussianRules, Rules};
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::reference::dynamic_gaussians::{DeformableParams, loss_and_gradient, phases_shown, shown};
use crate::reference::gaussians::{self as reference, N_PARAMS, Params};
use crate::selftest::compare::{Findings, Tolerance, told};
use crate::selftest::gaussians::{
    LOSS, NUMBERS, REPORT, SPLAT, TwinSplat, compare_backward, compare_gradient, compare_splats, device_gradient, f32s,
};
use crate::selftest::problems::{default_rules, deformable_case, fillings, hard_case, moving_set};
use crate::selftest::repeats::{ITERATIONS, bits_of, compare_runs, losses};
use glam::DVec3;

const PROJECT: &[&str] = &[push::DeformableProject::SHADER];
const GRADIENT: &[&str] = &[push::DeformableGradient::SHADER];
const GRID_GRADIENT: &[&str] = &[push::DeformableGridGradient::SHADER];
const UPDATE: &[&str] = &[push::DeformableUpdate::SHADER];
const GRID_UPDATE: &[&str] = &[push::DeformableGridUpdate::SHADER];
const GUESS: &[&str] = &[push::DeformableGuess::SHADER];
const FILL: &[&str] = &[push::DeformableFill::SHADER];
const FILLING: &[&str] = &[push::DeformableFilling::SHADER];

/// First steps of Adam, all of nearly the same length, which f32 displacements lose a little of.
const FIRST_STEP: Tolerance = Tolerance::OfLargest(2e-3);
/// Minimum slope that makes a full first step.
const STEEP: f64 = 1e-3;

fn flat(all: &[DVec3]) -> Vec<f64> {
    all.iter().flat_map(|v| v.to_array()).collect()
}

fn vectors(gpu: &Gpu, buffer: &Buffer, n: usize) -> Result<Vec<f32>> {
    let all: Vec<[f32; 4]> = gpu.download(buffer, 0, n)?;
    Ok(all.iter().flat_map(|v| v[..3].to_vec()).collect())
}

fn upload(gpu: &Gpu, buffer: &Buffer, all: &[DVec3]) -> Result<()> {
    Ok(gpu.upload(buffer, 0, &all.iter().map(|v| v.extend(0.0).as_vec4().to_array()).collect::<Vec<_>>())?)
}

/// Compares the stages of an iteration.
///
/// # Errors
/// Device errors.
pub fn compare(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    findings.begin("deformable", "31 Gaussians, 14 images of 33 x 27 pixels");
    let (targets, rows, config) = deformable_case()?;
    let mut trainer = DeformableTrainer::with(gpu, targets.clone(), &config, &Particles::fresh(rows.clone()))?;
    let (setup, deformable) = (*trainer.setup(), *trainer.deformable_setup());
    let p = moving_set(&rows, &deformable, targets.n_phases);
    upload(gpu, &trainer.grid().motion_grid, &p.grid)?;
    upload(gpu, &trainer.own_motion().own_motion, &p.own)?;
    let images = trainer.images()?;
    let (n, n_phases) = (rows.len(), targets.n_phases);
    let shown = shown_in_images(&targets, &deformable, &p);
    let seen = seen_in_images(&targets, &setup, &shown);
    compare_splats(gpu, trainer.particles(), &setup, PROJECT, &seen, findings)?;
    findings.numbers(SPLAT, "images", &images, &drawn(&targets, &setup, &seen), NUMBERS);
    let loss = told(trainer.advance(1))?.first().copied().unwrap_or(f64::NAN);
    let buffers = (trainer.target_buffers(), trainer.particles());
    let (twin_loss, moments) = compare_backward(gpu, (&targets, &setup), buffers, &images, &seen, findings)?;
    // By the device's moments: gradients of each Gaussian, and of its place at each phase.
    let (mut want, mut places) = (vec![[0.0; N_PARAMS]; n], vec![DVec3::ZERO; n_phases * n]);
    for (splat, shown) in shown.iter().enumerate() {
        let Some((phase, image, moved)) = shown else { continue };
        let view = &targets.views[*image];
        let one = reference::gradient(moved, view, &setup, moments[splat]);
        want[splat % n].iter_mut().zip(one).for_each(|(sum, g)| *sum += g);
        for (phase, share) in phases_shown(*phase, view, n_phases) {
            places[phase * n + splat % n] += share * DVec3::new(one[0], one[1], one[2]);
        }
    }
    compare_gradient(&device_gradient(gpu, trainer.particles(), n)?, &want, GRADIENT, findings);
    let got = vectors(gpu, &trainer.own_motion().place_gradient, places.len())?;
    let want: Vec<f64> = places.iter().flat_map(DVec3::to_array).collect();
    findings.numbers(GRADIENT, "gradient of positions", &got, &want, NUMBERS);
    let (_, _, gradient) = loss_and_gradient(&targets, &setup, &deformable, &p);
    compare_motion(gpu, &trainer, &deformable, (&p, &gradient), findings)?;
    findings.add(REPORT, "loss", (loss / twin_loss - 1.0).abs(), LOSS);
    compare_guess(gpu, &trainer, &p, n_phases, findings)?;
    compare_filling(gpu, findings)
}

/// Gaussian in an image: the phase, the image, and the Gaussian as it is there; none where a view lacks the phase.
type Shown = Option<(usize, usize, Params)>;

/// Gaussians in all images, `[phase][view][Gaussian]`.
fn shown_in_images(targets: &Targets, deformable: &MotionGridSetup, p: &DeformableParams) -> Vec<Shown> {
    let (n, n_views, n_phases) = (p.rows.len(), targets.n_views, targets.n_phases);
    let at = |splat: usize| {
        let (phase_and_view, i) = (splat / n, splat % n);
        let (phase, image) = (phase_and_view / n_views, targets.image_of[phase_and_view]?);
        Some((phase, image, shown(deformable, p, i, phase, &targets.views[image], n_phases)))
    };
    (0..n_phases * n_views * n).map(at).collect()
}

/// Splats of Gaussians in all images.
fn seen_in_images(targets: &Targets, setup: &GaussianSetup, shown: &[Shown]) -> Vec<TwinSplat> {
    let project = |(image, moved): (usize, &Params)| reference::project(moved, &targets.views[image], setup);
    shown.iter().map(|s| s.as_ref().map(|(_, image, moved)| (*image, project((*image, moved))))).collect()
}

/// Compares the stages that a set has besides where contrast comes or goes: filled splats, the gradient of the filling, and the first
/// step along it.
fn compare_filling(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    findings.begin("deformable", "31 Gaussians whose contrast comes and goes, 14 images of 33 x 27 pixels");
    let (mut targets, rows, config) = deformable_case()?;
    targets.contrast_comes_and_goes = true;
    let mut trainer = DeformableTrainer::with(gpu, targets.clone(), &config, &Particles::fresh(rows.clone()))?;
    let (setup, deformable) = (*trainer.setup(), *trainer.deformable_setup());
    let (n, n_phases) = (rows.len(), targets.n_phases);
    let mut p = moving_set(&rows, &deformable, n_phases);
    p.filling = fillings(n, n_phases, targets.rest_phase);
    upload(gpu, &trainer.grid().motion_grid, &p.grid)?;
    upload(gpu, &trainer.own_motion().own_motion, &p.own)?;
    let Some(buffers) = trainer.filling().cloned() else {
        return Err(Error::Internal("a set whose contrast comes and goes has no filling".into()));
    };
    gpu.upload(&buffers.filling, 0, &f32s(&p.filling))?;
    trainer.images()?;
    let seen = seen_in_images(&targets, &setup, &shown_in_images(&targets, &deformable, &p));
    compare_splats(gpu, trainer.particles(), &setup, FILL, &seen, findings)?;
    told(trainer.advance(1))?;
    // By the device's moments.
    let moments: Vec<[f32; 4]> = gpu.download(&trainer.particles().splat_moments, 0, 2 * seen.len())?;
    let mut slopes = vec![0.0; p.filling.len()];
    for (splat, seen) in seen.iter().enumerate() {
        let (phase, i) = (splat / n / targets.n_views, splat % n);
        let Some((image, _)) = seen else { continue };
        let shown = phases_shown(phase, &targets.views[*image], n_phases);
        let filled: f64 = shown.iter().map(|(at, share)| share * p.filling[i * n_phases + at]).sum();
        for (at, share) in shown {
            slopes[i * n_phases + at] += share * f64::from(moments[2 * splat][0]) / filled;
        }
    }
    let read = |buffer: &Buffer| gpu.download::<f32>(buffer, 0, slopes.len());
    findings.numbers(FILLING, "gradient of the filling", &read(&buffers.filling_gradient)?, &slopes, NUMBERS);
    // At the rest phase vessels are full by definition.
    let rests = |i: &usize| i % n_phases == targets.rest_phase;
    let first: Vec<f64> = (0..slopes.len()).map(|i| if rests(&i) { 0.0 } else { 0.1 * slopes[i] }).collect();
    findings.numbers(FILLING, "first moments of the filling", &read(&buffers.filling_first)?, &first, NUMBERS);
    let step = |i: usize| if rests(&i) { 0.0 } else { -f64::from(FILLING_RATE) * slopes[i].signum() };
    let bounded = |i: usize| (p.filling[i] + step(i)).clamp(MIN_FILLING.into(), 1.0) - p.filling[i];
    let steep: Vec<usize> = (0..slopes.len()).filter(|i| rests(i) || slopes[*i].abs() > STEEP).collect();
    let now = read(&buffers.filling)?;
    let moved: Vec<f64> = steep.iter().map(|i| f64::from(now[*i]) - p.filling[*i]).collect();
    let want: Vec<f64> = steep.iter().map(|i| bounded(*i)).collect();
    findings.numbers(FILLING, "first step of the filling", &f32s(&moved), &want, FIRST_STEP);
    findings.require(FILLING, "fillings with a slope", steep.len() > slopes.len() / 4);
    Ok(())
}

/// Images of splats as the twin sees them.
fn drawn(targets: &Targets, setup: &GaussianSetup, seen: &[TwinSplat]) -> Vec<f64> {
    let mut images = vec![0.0; targets.n_images * targets.n_pixels()];
    for (image, projection) in seen.iter().flatten() {
        if let Some(projection) = projection {
            projection.splat(setup, &mut images[image * targets.n_pixels()..][..targets.n_pixels()]);
        }
    }
    images
}

/// Compares gradients of grid and own motion, and the first step along them.
fn compare_motion(
    gpu: &Gpu,
    trainer: &DeformableTrainer,
    deformable: &MotionGridSetup,
    (p, gradient): (&DeformableParams, &DeformableParams),
    findings: &mut Findings,
) -> Result<()> {
    let (grid, own) = (trainer.grid(), trainer.own_motion());
    let slopes = flat(&gradient.grid);
    let got = vectors(gpu, &grid.motion_grid_gradient, p.grid.len())?;
    findings.numbers(GRID_GRADIENT, "gradient of the grid", &got, &slopes, NUMBERS);
    // After one update Adam's first moment is a tenth of the gradient.
    let first: Vec<f64> = flat(&gradient.own).iter().map(|g| 0.1 * g).collect();
    let got = vectors(gpu, &own.own_motion_first, p.own.len())?;
    findings.numbers(UPDATE, "first moments of own motion", &got, &first, NUMBERS);
    let first: Vec<f64> = slopes.iter().map(|g| 0.1 * g).collect();
    let got_first = vectors(gpu, &grid.motion_grid_first, p.grid.len())?;
    let got_own = vectors(gpu, &own.own_motion, p.own.len())?;
    let got_grid = vectors(gpu, &grid.motion_grid, p.grid.len())?;
    compare_step(UPDATE, &got_own, (&p.own, &gradient.own), deformable.own_rate.into(), findings);
    findings.numbers(GRID_UPDATE, "first moments of the grid", &got_first, &first, NUMBERS);
    compare_step(GRID_UPDATE, &got_grid, (&p.grid, &gradient.grid), deformable.grid_rate.into(), findings);
    Ok(())
}

/// Compares the first step: every number that has a slope moves by its rate, against the gradient.
fn compare_step(
    stages: &[&'static str],
    got: &[f32],
    (start, gradient): (&[DVec3], &[DVec3]),
    rate: f64,
    findings: &mut Findings,
) {
    let (start, slopes) = (flat(start), flat(gradient));
    let steep: Vec<usize> = (0..got.len()).filter(|i| slopes[*i].abs() > STEEP).collect();
    let moved: Vec<f64> = steep.iter().map(|i| f64::from(got[*i]) - start[*i]).collect();
    let want: Vec<f64> = steep.iter().map(|i| -rate * slopes[*i].signum()).collect();
    findings.numbers(stages, "first step", &f32s(&moved), &want, FIRST_STEP);
}

/// Compares where tracking begins: at the position of the phase before, plus half of its last step.
fn compare_guess(
    gpu: &Gpu,
    trainer: &DeformableTrainer,
    p: &DeformableParams,
    n_phases: usize,
    findings: &mut Findings,
) -> Result<()> {
    let (grid, nodes) = (trainer.grid(), p.grid.len() / n_phases);
    upload(gpu, &grid.motion_grid, &p.grid)?;
    let stage: Stage<push::DeformableGuess> = Build::default().stage(gpu)?;
    let mut recording = Recording::new(gpu, "guess")?;
    let push = push::DeformableGuess { phase: 3, before: 2, before_that: 1 };
    dispatch_finding(&mut recording, &stage, stage.groups_for(nodes as u32), &[], |name| grid.find(name), push)?;
    gpu.wait(recording.finish()?.submit()?)?;
    let mut want = p.grid.clone();
    for node in 0..nodes {
        let (last, before) = (p.grid[2 * nodes + node], p.grid[nodes + node]);
        want[3 * nodes + node] = last + 0.5 * (last - before);
    }
    findings.numbers(GUESS, "grid", &vectors(gpu, &grid.motion_grid, p.grid.len())?, &flat(&want), NUMBERS);
    Ok(())
}

/// Compares runs of Gaussians, a set per phase and one set that moves.
///
/// # Errors
/// Device errors.
pub fn compare_equal_runs(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    findings.begin("phase", "24 iterations, losses and Gaussians");
    let short = |rules: Rules| {
        let gaussians = GaussianRules { iterations: ITERATIONS, grow_at: 0, ..rules.gaussians };
        Rules { gaussians, ..rules }
    };
    let config = short(default_rules()?);
    let (targets, rows) = hard_case()?;
    let run = |stops: &[u32]| -> Result<Vec<u64>> {
        let mut trainer = GaussianTrainer::with(gpu, targets.clone(), &config, &Particles::fresh(rows.clone()))?;
        let mut bits = losses(stops, |stop| trainer.advance(stop))?;
        bits.extend(bits_of(&trainer.model()?.rows));
        Ok(bits)
    };
    compare_runs(run, findings)?;
    let (targets, rows, config) = deformable_case()?;
    let config = short(config);
    findings.begin("deformable", "24 iterations, losses, Gaussians and their motion");
    compare_equal_runs_of_one_set(gpu, &targets, &rows, &config, findings)?;
    findings.begin("deformable", "the same with contrast that comes and goes, and fillings");
    compare_equal_runs_of_one_set(gpu, &Targets { contrast_comes_and_goes: true, ..targets }, &rows, &config, findings)
}

/// Compares runs of one set that moves.
fn compare_equal_runs_of_one_set(
    gpu: &Gpu,
    targets: &Targets,
    rows: &[Gaussian],
    config: &Rules,
    findings: &mut Findings,
) -> Result<()> {
    let run = |stops: &[u32]| -> Result<Vec<u64>> {
        let mut trainer = DeformableTrainer::with(gpu, targets.clone(), config, &Particles::fresh(rows.to_vec()))?;
        let mut bits = losses(stops, |stop| trainer.advance(stop))?;
        let deformable = trainer.deformable()?;
        bits.extend(bits_of(&deformable.rest.rows));
        let motion = deformable.grid.iter().chain(&deformable.own).flatten();
        bits.extend(motion.chain(deformable.filling.iter().flatten()).map(|v| u64::from(v.to_bits())));
        Ok(bits)
    };
    compare_runs(run, findings)
}
