//! Fits a set of Gaussians per phase: many iterations per submit, and a step on the host where their number changes.

use crate::error::{Error, Result};
use crate::fitting::iterations::{Iterations, pass_times};
use crate::fitting::ring::losses;
use crate::gaussians::field::{AGAINST_DIVERGENCE, Gaussians, amplitude, dense};
use crate::gaussians::particles::{ParticleBuffers, Particles};
use crate::gaussians::stages::{GaussianKernels, GaussianPass, TargetBuffers, record_images, record_step};
use crate::gaussians::work::{GaussianWork, SplatCost};
use crate::gpu::device::Gpu;
use crate::gpu::record::{PassTime, Recording};
use crate::kernels::layout::{Gaussian, GaussianSetup};
use crate::methods::dynamic_gaussians::groups::vessels;
use crate::methods::dynamic_gaussians::rules::{FAINT, GaussianRules, Rules};
use crate::methods::dynamic_gaussians::target_buffers::{
    Renewal, TargetPart, renew_bounds, take_images, undivided_targets,
};
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::methods::dynamic_gaussians::{seeds, setup};

/// A run on a device.
pub struct GaussianTrainer {
    gpu: Gpu,
    targets: Targets,
    settings: GaussianRules,
    seed: u32,
    setup: GaussianSetup,
    per_submit: u32,
    kernels: GaussianKernels,
    part: TargetPart,
    particles: ParticleBuffers,
    n: u32,
    iterations: Iterations,
    step: u32,
}

impl GaussianTrainer {
    /// Seeds Gaussians in the hull of the targets.
    ///
    /// # Errors
    /// [`Error::Config`] for impossible settings; [`Error::Unmet`] when there is no place for a Gaussian; device errors.
    pub fn new(gpu: &Gpu, targets: Targets, config: &Rules) -> Result<GaussianTrainer> {
        let mut rows = seeds::seeds(&targets, &targets.lengths.gaussians(&config.gaussians), config.seed);
        let trainer = Self::with(gpu, targets, config, &Particles::fresh(rows.clone()))?;
        let density = seeds::first_density(&trainer.targets, &trainer.images()?);
        rows.iter_mut().for_each(|g| g.log_density = density.ln() as f32);
        gpu.upload(&trainer.particles.gaussians, 0, &rows)?;
        Ok(trainer)
    }

    /// Starts from given Gaussians.
    ///
    /// # Errors
    /// As [`GaussianTrainer::new`].
    pub fn with(gpu: &Gpu, targets: Targets, config: &Rules, particles: &Particles) -> Result<GaussianTrainer> {
        let n = check_count(particles)?;
        let settings = targets.lengths.gaussians(&config.gaussians);
        let setup = setup::gaussian_setup(&targets, &settings);
        let kernels = GaussianKernels::new(gpu)?;
        let part = undivided_targets(gpu, &targets, &setup, &setup::schedule(&settings))?;
        let particles = particles.upload(gpu, setup.n_views)?;
        let per_submit = config.train.iterations_per_submit;
        let iterations = record(gpu, &kernels, &part.buffers, &particles, &setup, n, per_submit)?;
        Ok(GaussianTrainer {
            gpu: gpu.clone(),
            targets,
            settings,
            seed: config.seed,
            setup,
            per_submit,
            kernels,
            part,
            particles,
            n,
            iterations,
            step: 0,
        })
    }

    /// Iterations done.
    pub fn step(&self) -> u32 {
        self.step
    }

    /// Number of Gaussians of all phases.
    pub fn count(&self) -> u32 {
        self.n
    }

    /// Targets of the run.
    pub fn targets(&self) -> &Targets {
        &self.targets
    }

    /// Returns the targets when the run is over.
    pub(super) fn into_targets(self) -> Targets {
        self.targets
    }

    /// Constants of the run.
    pub fn setup(&self) -> &GaussianSetup {
        &self.setup
    }

    /// The Gaussians on the device, for rendering while training and for tests.
    pub fn particles(&self) -> &ParticleBuffers {
        &self.particles
    }

    /// Target buffers on the device, for tests.
    pub fn target_buffers(&self) -> &TargetBuffers {
        &self.part.buffers
    }

    /// Runs a submit's worth of iterations towards `until`, at most to where the number of Gaussians changes; returns the
    /// losses of the iterations done. An empty list means the target was reached before.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite; device errors.
    pub fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        let until = until.min(self.settings.iterations);
        if self.step >= until {
            return Ok(Vec::new());
        }
        let settings = &self.settings;
        let (renew, grow) = (setup::renews_background(settings, self.step), setup::grows(settings, self.step));
        let clear = setup::clears(settings, self.step);
        let stop = setup::next_stop(settings, self.step, until);
        if renew {
            self.renew_background()?;
        }
        if grow {
            self.grow()?;
        }
        if clear {
            self.clear()?;
        }
        let first = self.step;
        self.step += self.iterations.run(&self.gpu, first, stop)?;
        if setup::parts_from_strays(&self.settings, self.step) {
            self.drop_strays()?;
        }
        losses(&self.gpu, &self.part.buffers.gaussian_ring, first..self.step, AGAINST_DIVERGENCE)
    }

    /// Estimates the static background anew from what the Gaussians leave of the images, and with it the bounds of the
    /// fit's targets.
    pub(super) fn renew_background(&mut self) -> Result<()> {
        let images = self.images()?;
        let parts = std::slice::from_ref(&self.part);
        renew_bounds(&self.gpu, &mut self.targets, parts, &self.setup, &images, Renewal::OneOfSeveral)
    }

    /// Drops weak Gaussians and places new ones where data are missing. This happens once in a run, so the host does it: it
    /// needs the hull's cells and a weighted draw, a few megabytes each way.
    fn grow(&mut self) -> Result<()> {
        let mut particles = self.particles.download(&self.gpu, self.n as usize)?;
        particles.retain(&strong(&particles.rows, &self.setup, self.settings.prune_threshold));
        self.replace(&particles)?;
        let images = self.images()?;
        particles.append(seeds::additions(&self.targets, &self.settings, self.seed, &images));
        self.replace(&particles)
    }

    /// Drops Gaussians that are too faint for vessels: they stand for other motion.
    fn clear(&mut self) -> Result<()> {
        let mut particles = self.particles.download(&self.gpu, self.n as usize)?;
        particles.retain(&dense(&particles.rows, &self.setup, FAINT));
        self.replace(&particles)
    }

    /// Drops Gaussians that are alone and broad.
    fn drop_strays(&mut self) -> Result<()> {
        let mut particles = self.particles.download(&self.gpu, self.n as usize)?;
        particles.retain(&vessels(&particles.rows, &self.setup, self.settings.link));
        self.replace(&particles)
    }

    fn replace(&mut self, particles: &Particles) -> Result<()> {
        self.n = check_count(particles)?;
        self.particles = particles.upload(&self.gpu, self.setup.n_views)?;
        let (setup, n) = (&self.setup, self.n);
        self.iterations =
            record(&self.gpu, &self.kernels, &self.part.buffers, &self.particles, setup, n, self.per_submit)?;
        Ok(())
    }

    fn pass<'a>(&'a self, recording: &'a mut Recording) -> GaussianPass<'a> {
        let (kernels, targets, particles) = (&self.kernels, &self.part.buffers, &self.particles);
        GaussianPass { recording, kernels, targets, particles, setup: &self.setup, n: self.n }
    }

    /// Images of the present field, `[image][pixel]`, shares of the strongest change.
    ///
    /// # Errors
    /// Device errors.
    pub fn images(&self) -> Result<Vec<f32>> {
        let mut recording = Recording::new(&self.gpu, "images of Gaussians")?;
        record_images(&mut self.pass(&mut recording))?;
        self.gpu.wait(recording.finish()?.submit()?)?;
        let mut images = Vec::with_capacity(self.targets.n_images * self.targets.n_pixels());
        take_images(&self.gpu, &self.part, &self.targets, &self.setup, &mut images)?;
        Ok(images)
    }

    /// The field after the iterations done.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a parameter is not finite; device errors.
    pub fn model(&self) -> Result<Gaussians> {
        let model = Gaussians {
            units: self.targets.units,
            n_phases: self.targets.n_phases,
            setup: self.setup,
            rows: self.gpu.download(&self.particles.gaussians, 0, self.n as usize)?,
            step: self.step,
            is_crowd: false,
            agreement: None,
            intensities: None,
        };
        model.check()?;
        Ok(model)
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// Device errors.
    pub fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        let mut recording = Recording::timed(&self.gpu, "profiled iteration of Gaussians", MAX_PASSES)?;
        record_step(&mut self.pass(&mut recording))?;
        self.step += 1;
        pass_times(&self.gpu, recording)
    }

    /// Work of the last iteration.
    ///
    /// # Errors
    /// Device errors.
    pub fn work(&self) -> Result<GaussianWork> {
        let splats = (&self.particles.splats, &self.particles.image_of_splat);
        GaussianWork::of(&self.gpu, &self.setup, splats, self.n * self.setup.n_views, SplatCost::AFFINE)
    }
}

/// Maximum number of passes of a timed iteration.
pub(super) const MAX_PASSES: u32 = 64;

/// Tells which Gaussians show more than the weakest that is kept.
pub(super) fn strong(rows: &[Gaussian], setup: &GaussianSetup, weakest: f64) -> Vec<bool> {
    rows.iter().map(|g| amplitude(g, setup) > weakest).collect()
}

/// Returns the number of Gaussians; refuses none and too many.
pub(super) fn check_count(particles: &Particles) -> Result<u32> {
    let n = particles.rows.len();
    if n == 0 {
        let problem =
            "no Gaussian is left: there is no motion in the images; `nertca-vk check` shows what they contain";
        return Err(Error::unmet("gaussians.count", n, problem));
    }
    u32::try_from(n).map_err(|_| Error::config("gaussians.count", n, "is too many Gaussians"))
}

fn record(
    gpu: &Gpu,
    kernels: &GaussianKernels,
    targets: &TargetBuffers,
    particles: &ParticleBuffers,
    setup: &GaussianSetup,
    n: u32,
    per_submit: u32,
) -> Result<Iterations> {
    Iterations::record(gpu, per_submit, |iterations| {
        let mut recording = Recording::new(gpu, &format!("{iterations} iterations of Gaussians"))?;
        let mut pass = GaussianPass { recording: &mut recording, kernels, targets, particles, setup, n };
        for _ in 0..iterations {
            record_step(&mut pass)?;
        }
        Ok(recording.finish()?)
    })
}
