//! One set of Gaussians that moves over the beat: an iteration of its fit, stage by stage.

use crate::error::Result;
use crate::gaussians::particles::Particles;
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::Recording;
use crate::kernels::dispatch::{BufferSet, dispatch_finding};
use crate::kernels::layout::TreeSetup;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage};
use crate::reference::gaussians::{self as reference, N_PARAMS, Params};
use crate::reference::tree::{TreeParams, at_phase, loss_and_gradient};
use crate::selftest::compare::{Findings, Tolerance};
use crate::selftest::gaussians::{
    LOSS, NUMBERS, REPORT, SPLAT, Seen, compare_backward, compare_gradient, compare_splats, device_gradient, f32s,
    twin_images,
};
use crate::selftest::problems::{moving_tree, tree_case};
use crate::train::tree::TreeTrainer;
use glam::DVec3;

const PROJECT: &[&str] = &[push::TreeProject::SHADER];
const GRADIENT: &[&str] = &[push::TreeGradient::SHADER];
const GRID_GRADIENT: &[&str] = &[push::TreeGridGradient::SHADER];
const UPDATE: &[&str] = &[push::TreeUpdate::SHADER];
const GRID_UPDATE: &[&str] = &[push::TreeGridUpdate::SHADER];
const GUESS: &[&str] = &[push::TreeGuess::SHADER];

/// First steps of Adam, all of nearly the same length, which f32 displacements lose a little of.
const FIRST_STEP: Tolerance = Tolerance::OfLargest(2e-3);
/// Slopes below this make no whole first step.
const STEEP: f64 = 1e-3;

fn flat(all: &[DVec3]) -> Vec<f64> {
    all.iter().flat_map(|v| v.to_array()).collect()
}

fn vectors(gpu: &Gpu, buffer: &Buffer, n: usize) -> Result<Vec<f32>> {
    let all: Vec<[f32; 4]> = gpu.download(buffer, 0, n)?;
    Ok(all.iter().flat_map(|v| v[..3].to_vec()).collect())
}

fn upload(gpu: &Gpu, buffer: &Buffer, all: &[DVec3]) -> Result<()> {
    gpu.upload(buffer, 0, &all.iter().map(|v| v.extend(0.0).as_vec4().to_array()).collect::<Vec<_>>())
}

/// Compares the stages of an iteration.
///
/// # Errors
/// Device errors.
pub fn compare(gpu: &Gpu, findings: &mut Findings) -> Result<()> {
    findings.begin("tree", "31 Gaussians, 14 images of 33 x 27 pixels");
    let (targets, rows, config) = tree_case()?;
    let mut trainer = TreeTrainer::with(gpu, targets.clone(), &config, &Particles::fresh(rows.clone()))?;
    let (setup, tree) = (*trainer.setup(), *trainer.tree_setup());
    let p = moving_tree(&rows, &tree, targets.n_phases);
    upload(gpu, &trainer.grid().motion_grid, &p.grid)?;
    upload(gpu, &trainer.own_motion().own_motion, &p.own)?;
    let images = trainer.images()?;
    let (n, n_views, n_phases) = (rows.len(), targets.n_views, targets.n_phases);
    let everywhere: Vec<(Params, usize)> = (0..n_phases)
        .flat_map(|phase| (0..n).map(move |i| (phase, i)))
        .map(|(phase, i)| (at_phase(&tree, &p, i, phase, n_phases), phase))
        .collect();
    let seen: Vec<Seen> = (0..n_phases * n_views * n)
        .map(|at| {
            let (phase_and_view, i) = (at / n, at % n);
            let image = targets.image_of[phase_and_view]?;
            let moved = &everywhere[phase_and_view / n_views * n + i].0;
            Some((image, reference::project(moved, &targets.views[image], &setup)))
        })
        .collect();
    compare_splats(gpu, trainer.particles(), &setup, PROJECT, &seen, findings)?;
    findings.numbers(SPLAT, "images", &images, &twin_images(&targets, &setup, &everywhere), NUMBERS);
    let loss = trainer.advance(1)?.first().copied().unwrap_or(f64::NAN);
    let buffers = (trainer.target_buffers(), trainer.particles());
    let (twin_loss, moments) = compare_backward(gpu, (&targets, &setup), buffers, &images, &seen, findings)?;
    // Gradients of each Gaussian at each phase by the device's moments.
    let gradient = |at: usize| {
        let (phase, i) = (at / n, at % n);
        let mut sum = [0.0; N_PARAMS];
        for view in 0..n_views {
            let splat = (phase * n_views + view) * n + i;
            if let Some((image, Some(_))) = &seen[splat] {
                let one = reference::gradient(&everywhere[at].0, &targets.views[*image], &setup, moments[splat]);
                sum.iter_mut().zip(one).for_each(|(sum, g)| *sum += g);
            }
        }
        sum
    };
    let places: Vec<Params> = (0..everywhere.len()).map(gradient).collect();
    let mut want = vec![[0.0; N_PARAMS]; n];
    for (at, place) in places.iter().enumerate() {
        want[at % n].iter_mut().zip(place).for_each(|(sum, g)| *sum += g);
    }
    compare_gradient(&device_gradient(gpu, trainer.particles(), n)?, &want, GRADIENT, findings);
    let want: Vec<f64> = places.iter().flat_map(|g| g[..3].to_vec()).collect();
    let got = vectors(gpu, &trainer.own_motion().place_gradient, places.len())?;
    findings.numbers(GRADIENT, "gradient of places", &got, &want, NUMBERS);
    let (_, _, gradient) = loss_and_gradient(&targets, &setup, &tree, &p);
    compare_motion(gpu, &trainer, &tree, (&p, &gradient), findings)?;
    findings.add(REPORT, "loss", (loss / twin_loss - 1.0).abs(), LOSS);
    compare_guess(gpu, &trainer, &p, n_phases, findings)
}

/// Gradients of grid and own motion, and the first step along them.
fn compare_motion(
    gpu: &Gpu,
    trainer: &TreeTrainer,
    tree: &TreeSetup,
    (p, gradient): (&TreeParams, &TreeParams),
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
    compare_step(UPDATE, &got_own, (&p.own, &gradient.own), tree.own_rate.into(), findings);
    findings.numbers(GRID_UPDATE, "first moments of the grid", &got_first, &first, NUMBERS);
    compare_step(GRID_UPDATE, &got_grid, (&p.grid, &gradient.grid), tree.grid_rate.into(), findings);
    Ok(())
}

/// Every number that has a slope moves by its rate, against the gradient.
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

/// Where tracking begins: as at the phase before, and half its last step on.
fn compare_guess(
    gpu: &Gpu,
    trainer: &TreeTrainer,
    p: &TreeParams,
    n_phases: usize,
    findings: &mut Findings,
) -> Result<()> {
    let (grid, nodes) = (trainer.grid(), p.grid.len() / n_phases);
    upload(gpu, &grid.motion_grid, &p.grid)?;
    let stage: Stage<push::TreeGuess> = Build::default().stage(gpu)?;
    let mut recording = Recording::new(gpu, "guess")?;
    let push = push::TreeGuess { phase: 3, before: 2, before_that: 1 };
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
