//! Fits Gaussians to a scene: many iterations per submit, and a step on the host where their number changes.

use super::layout::GaussianSetup;
use super::model::{Gaussians, amplitude};
use super::scene::Scene;
use super::seed;
use super::settings::Settings;
use super::stages::{self, GaussianKernels, Particles, RING_LENGTH, record_images, record_step};
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::record::{Commands, PassTime, Recording};
use crate::kernels::Buffers;
use std::ops::Range;

/// Iterations that go into one submit: a CPU driver runs that many without waiting for the host.
pub(super) const ITERATIONS_PER_SUBMIT: u32 = 10;

/// A run on a device.
pub struct GaussianTrainer {
    gpu: Gpu,
    scene: Scene,
    settings: Settings,
    setup: GaussianSetup,
    kernels: GaussianKernels,
    buffers: Buffers,
    n: u32,
    several: Commands,
    single: Commands,
    step: u32,
}

impl GaussianTrainer {
    /// Seeds Gaussians in the scene's hull.
    ///
    /// # Errors
    /// [`Error::Config`] for impossible settings or when there is no place for a Gaussian; device errors.
    pub fn new(gpu: &Gpu, scene: Scene, settings: Settings) -> Result<GaussianTrainer> {
        settings.check()?;
        let setup = stages::setup(&scene, &settings);
        let seeds = seed::seeds(&scene, &settings, &setup);
        Self::with(gpu, scene, settings, Particles::fresh(seeds))
    }

    /// Starts from given Gaussians.
    ///
    /// # Errors
    /// As [`GaussianTrainer::new`].
    pub fn with(gpu: &Gpu, scene: Scene, settings: Settings, particles: Particles) -> Result<GaussianTrainer> {
        settings.check()?;
        let setup = stages::setup(&scene, &settings);
        let n = check_count(particles.rows.len())?;
        let kernels = GaussianKernels::new(gpu)?;
        let mut buffers = stages::scene_buffers(gpu, &scene, &setup, &settings)?;
        particles.upload(gpu, &setup, &mut buffers)?;
        let (several, single) = record(gpu, &kernels, &buffers, &setup, n)?;
        Ok(GaussianTrainer { gpu: gpu.clone(), scene, settings, setup, kernels, buffers, n, several, single, step: 0 })
    }

    /// Iterations done.
    pub fn step(&self) -> u32 {
        self.step
    }

    /// Gaussians of all phases.
    pub fn count(&self) -> u32 {
        self.n
    }

    /// What the run is fitted to.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Constants of the run.
    pub fn setup(&self) -> &GaussianSetup {
        &self.setup
    }

    /// Buffers, for rendering while training and for tests.
    pub fn buffers(&self) -> &Buffers {
        &self.buffers
    }

    /// Runs a submit's worth of iterations towards `until`, at most to where the number of Gaussians changes; the losses
    /// of the iterations done. An empty list means the target was reached before.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite; device errors.
    pub fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        let until = until.min(self.settings.iterations);
        if self.step >= until {
            return Ok(Vec::new());
        }
        if self.grows_at(self.step) {
            self.grow()?;
        }
        let stop = if self.settings.grow_at > self.step { until.min(self.settings.grow_at) } else { until };
        let several = stop - self.step >= ITERATIONS_PER_SUBMIT;
        let (commands, n) = if several { (&self.several, ITERATIONS_PER_SUBMIT) } else { (&self.single, 1) };
        self.gpu.wait(commands.submit()?)?;
        self.step += n;
        self.losses(n)
    }

    fn grows_at(&self, step: u32) -> bool {
        self.settings.grow_at > 0 && step == self.settings.grow_at
    }

    fn losses(&self, n: u32) -> Result<Vec<f64>> {
        let mut ring = vec![0f32; RING_LENGTH as usize];
        self.buffers.get("gaussian_ring")?.read(&mut ring)?;
        check_finite(&ring, self.step - n..self.step)
    }

    /// Drops weak Gaussians and places new ones where data are missing. Once in a run, so it is the host's work: it needs
    /// the hull's cells and a weighted draw, a few megabytes each way.
    fn grow(&mut self) -> Result<()> {
        let mut particles = Particles::download(&self.gpu, self.n as usize, &self.buffers)?;
        let (setup, weakest) = (self.setup, self.settings.weakest);
        particles.retain(|g| amplitude(g, &setup) > weakest);
        check_count(particles.rows.len())?;
        self.replace(&particles)?;
        let additions = seed::additions(&self.scene, &self.settings, &self.images()?, 1);
        particles.append(additions);
        self.replace(&particles)
    }

    fn replace(&mut self, particles: &Particles) -> Result<()> {
        self.n = check_count(particles.rows.len())?;
        particles.upload(&self.gpu, &self.setup, &mut self.buffers)?;
        (self.several, self.single) = record(&self.gpu, &self.kernels, &self.buffers, &self.setup, self.n)?;
        Ok(())
    }

    /// Images of the present field, `[image][pixel]`, shares of the strongest change.
    ///
    /// # Errors
    /// Device errors.
    pub fn images(&self) -> Result<Vec<f32>> {
        let mut recording = Recording::new(&self.gpu, "gaussian images")?;
        record_images(&mut recording, &self.kernels, &self.buffers, &self.setup, self.n)?;
        self.gpu.wait(recording.finish()?.submit()?)?;
        stages::take_images(&self.gpu, &self.buffers, &self.scene, &self.setup)
    }

    /// The field after the iterations done.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a parameter is not finite; device errors.
    pub fn model(&self) -> Result<Gaussians> {
        let model = Gaussians {
            units: self.scene.units,
            n_phases: self.scene.n_phases,
            setup: self.setup,
            rows: self.gpu.download(self.buffers.get("gaussians")?, 0, self.n as usize)?,
            step: self.step,
        };
        model.check()?;
        Ok(model)
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// Device errors.
    pub fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        const MAX_PASSES: u32 = 16;
        let mut recording = Recording::timed(&self.gpu, "profiled iteration", MAX_PASSES)?;
        record_step(&mut recording, &self.kernels, &self.buffers, &self.setup, self.n)?;
        let commands = recording.finish()?;
        self.gpu.wait(commands.submit()?)?;
        self.step += 1;
        commands.pass_times()
    }
}

/// The losses of some iterations.
pub(super) fn check_finite(ring: &[f32], steps: Range<u32>) -> Result<Vec<f64>> {
    let losses: Vec<f64> = steps.clone().map(|s| f64::from(ring[(s % RING_LENGTH) as usize])).collect();
    match losses.iter().position(|l| !l.is_finite()) {
        Some(at) => {
            let step = u64::from(steps.start) + at as u64 + 1;
            Err(Error::Diverged { step, quantity: "loss of the Gaussians", value: losses[at] })
        }
        None => Ok(losses),
    }
}

pub(super) fn check_count(n: usize) -> Result<u32> {
    if n == 0 {
        let problem = "no Gaussian is left: nothing in the images moves, or gaussians.weakest is too high";
        return Err(Error::config("gaussians.count", n, problem));
    }
    u32::try_from(n).map_err(|_| Error::config("gaussians.count", n, "too many Gaussians"))
}

fn record(
    gpu: &Gpu,
    kernels: &GaussianKernels,
    buffers: &Buffers,
    setup: &GaussianSetup,
    n: u32,
) -> Result<(Commands, Commands)> {
    let make = |iterations: u32| -> Result<Commands> {
        let mut recording = Recording::new(gpu, &format!("{iterations} iterations of Gaussians"))?;
        for _ in 0..iterations {
            record_step(&mut recording, kernels, buffers, setup, n)?;
        }
        recording.finish()
    };
    Ok((make(ITERATIONS_PER_SUBMIT)?, make(1)?))
}
