//! Fits a moving tree: phase 0 alone, then the grid tracked from phase to phase, then everything together.

use super::super::model::{Gaussians, amplitude};
use super::super::scene::Scene;
use super::super::seed;
use super::super::settings::Settings;
use super::super::stages::{self, Particles, RING_LENGTH};
use super::super::trainer::{GaussianTrainer, ITERATIONS_PER_SUBMIT, check_count, check_finite};
use super::model::Tree;
use super::settings::TreeSettings;
use super::stages::{OwnMotion, Sizes, TreeKernels, record_images, record_step, record_track, scene_buffers, setup};
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::record::{Commands, Recording};
use crate::kernels::Buffers;
use glam::DVec3;

/// A run on a device.
pub struct TreeTrainer {
    gpu: Gpu,
    scene: Scene,
    settings: Settings,
    kernels: TreeKernels,
    buffers: Buffers,
    sizes: Sizes,
    several: Commands,
    single: Commands,
    step: u32,
}

impl TreeTrainer {
    /// Fits phase 0 alone, makes a tree of what it shows, and tracks it through the beat.
    ///
    /// # Errors
    /// [`Error::Config`] for impossible settings or when phase 0 shows nothing; device errors.
    pub fn new(gpu: &Gpu, scene: Scene, settings: Settings, of_tree: &TreeSettings) -> Result<TreeTrainer> {
        settings.check()?;
        let warm = Settings { iterations: of_tree.warm_iterations.max(1), ..settings.clone() };
        let mut first = GaussianTrainer::new(gpu, scene.only(0), warm.clone())?;
        while first.step() < warm.iterations {
            first.advance(warm.iterations)?;
        }
        let mut rows = first.model()?.rows;
        let setup = *first.setup();
        drop(first);
        rows.retain(|g| amplitude(g, &setup) > of_tree.take);
        let trainer = Self::with(gpu, scene, settings, of_tree, Particles::fresh(rows))?;
        trainer.track(of_tree)?;
        Ok(trainer)
    }

    /// Starts from given Gaussians of phase 0 at rest.
    ///
    /// # Errors
    /// As [`TreeTrainer::new`].
    pub fn with(
        gpu: &Gpu,
        scene: Scene,
        settings: Settings,
        of_tree: &TreeSettings,
        particles: Particles,
    ) -> Result<TreeTrainer> {
        settings.check()?;
        let tree = setup(&scene, of_tree);
        let sizes = Sizes { n: check_count(particles.rows.len())?, setup: stages::setup(&scene, &settings), tree };
        let kernels = TreeKernels::new(gpu)?;
        let mut buffers = scene_buffers(gpu, &scene, &sizes.setup, &tree, (&settings, of_tree))?;
        let own = OwnMotion::none(particles.rows.len() * tree.n_basis as usize);
        own.upload(gpu, &particles, &sizes.setup, &mut buffers)?;
        let (several, single) = record(gpu, &kernels, &buffers, &sizes)?;
        Ok(TreeTrainer { gpu: gpu.clone(), scene, settings, kernels, buffers, sizes, several, single, step: 0 })
    }

    /// Tracks the grid forward and backward from phase 0 to the middle of the beat, on blurred images.
    fn track(&self, settings: &TreeSettings) -> Result<()> {
        let n = self.sizes.setup.n_phases;
        let forward = (1..=n / 2).map(|t| [t, t - 1, t.saturating_sub(2)]);
        let backward = (n / 2 + 1..n).rev().map(|t| [t, (t + 1) % n, if t + 2 < n { t + 2 } else { 0 }]);
        for path in forward.chain(backward) {
            let images: Vec<usize> = self.scene.views_at(path[0] as usize).map(|(image, _)| image).collect();
            let images = images.first().map_or(0..0, |first| *first as u32..(first + images.len()) as u32);
            let iterations = if images.is_empty() { 0 } else { settings.track_iterations };
            let mut recording = Recording::new(&self.gpu, "tracking")?;
            record_track(&mut recording, &self.kernels, &self.buffers, &self.sizes, path, images, iterations)?;
            self.gpu.wait(recording.finish()?.submit()?)?;
        }
        // What follows begins without momentum.
        let mut recording = Recording::new(&self.gpu, "clear momentum")?;
        for name in ["grid_first", "grid_second"] {
            recording.fill(self.buffers.get(name)?, 0);
        }
        self.gpu.wait(recording.finish()?.submit()?)
    }

    /// Iterations done, those of phase 0 and of tracking not counted.
    pub fn step(&self) -> u32 {
        self.step
    }

    /// What the run is fitted to.
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Sizes and constants of the run.
    pub fn sizes(&self) -> &Sizes {
        &self.sizes
    }

    /// Buffers, for rendering while training and for tests.
    pub fn buffers(&self) -> &Buffers {
        &self.buffers
    }

    /// Runs a submit's worth of iterations towards `until`, at most to where the number of Gaussians changes; the losses
    /// of the iterations done, penalties not included. An empty list means the target was reached before.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite; device errors.
    pub fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        let until = until.min(self.settings.iterations);
        if self.step >= until {
            return Ok(Vec::new());
        }
        let grow_at = self.settings.grow_at;
        if grow_at > 0 && self.step == grow_at {
            self.grow()?;
        }
        let stop = if grow_at > self.step { until.min(grow_at) } else { until };
        let several = stop - self.step >= ITERATIONS_PER_SUBMIT;
        let (commands, n) = if several { (&self.several, ITERATIONS_PER_SUBMIT) } else { (&self.single, 1) };
        self.gpu.wait(commands.submit()?)?;
        self.step += n;
        let mut ring = vec![0f32; RING_LENGTH as usize];
        self.buffers.get("gaussian_ring")?.read(&mut ring)?;
        check_finite(&ring, self.step - n..self.step)
    }

    /// Drops weak Gaussians and places new ones where data are missing at half the phases. Once in a run, on the host, as
    /// with a set per phase.
    fn grow(&mut self) -> Result<()> {
        let (n, n_basis) = (self.sizes.n as usize, self.sizes.tree.n_basis as usize);
        let mut particles = Particles::download(&self.gpu, n, &self.buffers)?;
        let mut own = OwnMotion::download(&self.gpu, n * n_basis, &self.buffers)?;
        let (setup, weakest) = (self.sizes.setup, self.settings.weakest);
        let keep: Vec<bool> = particles.rows.iter().map(|g| amplitude(g, &setup) > weakest).collect();
        particles.retain(|g| amplitude(g, &setup) > weakest);
        for numbers in [&mut own.amplitudes, &mut own.first, &mut own.second] {
            let mut at = 0..;
            numbers.retain(|_| at.next().is_some_and(|i| keep[i / n_basis]));
        }
        self.replace(&particles, &own)?;
        let tree = self.tree()?;
        let carried = |x: DVec3, phase: usize| tree.carried(x, phase as f64);
        let additions = seed::tree_additions(&self.scene, &self.settings, &self.images()?, 1, carried);
        // They move as their nearest neighbour does.
        for g in &additions {
            let nearest = tree.nearest(DVec3::from_array(g.position.map(f64::from)));
            own.amplitudes.extend(&tree.own[nearest * n_basis..][..n_basis]);
            own.first.extend(vec![[0.0; 4]; n_basis]);
            own.second.extend(vec![[0.0; 4]; n_basis]);
        }
        particles.append(additions);
        self.replace(&particles, &own)
    }

    fn replace(&mut self, particles: &Particles, own: &OwnMotion) -> Result<()> {
        self.sizes.n = check_count(particles.rows.len())?;
        own.upload(&self.gpu, particles, &self.sizes.setup, &mut self.buffers)?;
        (self.several, self.single) = record(&self.gpu, &self.kernels, &self.buffers, &self.sizes)?;
        Ok(())
    }

    /// Images of the present field, `[image][pixel]`, shares of the strongest change.
    ///
    /// # Errors
    /// Device errors.
    pub fn images(&self) -> Result<Vec<f32>> {
        let mut recording = Recording::new(&self.gpu, "tree images")?;
        let phases = 0..self.sizes.setup.n_phases;
        record_images(&mut recording, &self.kernels, &self.buffers, &self.sizes, phases, &[])?;
        self.gpu.wait(recording.finish()?.submit()?)?;
        stages::take_images(&self.gpu, &self.buffers, &self.scene, &self.sizes.setup)
    }

    /// The tree after the iterations done.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a parameter is not finite; device errors.
    pub fn tree(&self) -> Result<Tree> {
        let (n, tree) = (self.sizes.n as usize, self.sizes.tree);
        let grid: Vec<[f32; 4]> =
            self.gpu.download(self.buffers.get("grid")?, 0, self.scene.n_phases * tree.nodes())?;
        let own: Vec<[f32; 4]> = self.gpu.download(self.buffers.get("own_motion")?, 0, n * tree.n_basis as usize)?;
        if let Some(bad) = grid.iter().chain(&own).flatten().find(|v| !v.is_finite()) {
            let step = u64::from(self.step);
            return Err(Error::Diverged { step, quantity: "motion of the tree", value: f64::from(*bad) });
        }
        let rest = Gaussians {
            units: self.scene.units,
            n_phases: self.scene.n_phases,
            setup: self.sizes.setup,
            rows: self.gpu.download(self.buffers.get("gaussians")?, 0, n)?,
            step: self.step,
        };
        rest.check()?;
        Ok(Tree { rest, setup: tree, grid, own })
    }
}

fn record(gpu: &Gpu, kernels: &TreeKernels, buffers: &Buffers, sizes: &Sizes) -> Result<(Commands, Commands)> {
    let make = |iterations: u32| -> Result<Commands> {
        let mut recording = Recording::new(gpu, &format!("{iterations} iterations of a tree"))?;
        for _ in 0..iterations {
            record_step(&mut recording, kernels, buffers, sizes)?;
        }
        recording.finish()
    };
    Ok((make(ITERATIONS_PER_SUBMIT)?, make(1)?))
}
