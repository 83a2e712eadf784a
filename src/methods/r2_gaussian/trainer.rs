//! Fits Gaussians as R2-Gaussian does: all sets at once, one view each per iteration, and density control on the host.

use crate::config::sections::R2Settings;
use crate::config::{Config, R2Integral};
use crate::error::{Error, Result};
use crate::fitting::iterations::{Iterations, pass_times};
use crate::fitting::ring::{losses, ring};
use crate::fitting::shown::SetsFit;
use crate::gaussians::field::Gaussians;
use crate::gaussians::work::{GaussianWork, SplatCost};
use crate::gpu::buffer::Memory;
use crate::gpu::device::Gpu;
use crate::gpu::record::{PassTime, Recording};
use crate::kernels::dispatch::Binding;
use crate::kernels::layout::{GaussianSetup, PictureSetup, R2Gaussian, R2Setup};
use crate::methods::r2_gaussian::data::R2Data;
use crate::methods::r2_gaussian::densify::{densified, densifies};
use crate::methods::r2_gaussian::parameters::ScaleBounds;
use crate::methods::r2_gaussian::particles::R2ParticleBuffers;
use crate::methods::r2_gaussian::setup::{R2Setups, gaussian_setup, picture_setup, r2_setup, schedule, turns};
use crate::methods::r2_gaussian::stages::{R2Buffers, R2Kernels, R2Parts, R2Pass, record_step};
use crate::methods::r2_gaussian::start::first_rows;
use crate::methods::r2_gaussian::state::{R2State, SMALLER_STEPS};

/// Maximum number of passes of a timed iteration.
const MAX_PASSES: u32 = 64;

/// A run on a device.
pub struct R2Trainer {
    gpu: Gpu,
    data: R2Data,
    config: Config<R2Settings>,
    setup: GaussianSetup,
    r2: R2Setup,
    pictures: PictureSetup,
    kernels: R2Kernels,
    buffers: R2Buffers,
    particles: R2ParticleBuffers,
    n: u32,
    iterations: Iterations,
    step: u32,
}

impl R2Trainer {
    /// Begins where the settings say; returns the run, and notes about its beginning for the user.
    ///
    /// # Errors
    /// [`Error::Config`] for impossible settings; device errors.
    pub fn new(gpu: &Gpu, data: R2Data, config: &Config<R2Settings>) -> Result<(R2Trainer, Vec<String>)> {
        let (rows, mut notes) = first_rows(&data, &config.r2, config.seed);
        let max = max_of_set(gpu, &data);
        if max < config.r2.max_num_gaussians {
            notes.push(format!(
                "a set has at most {max} Gaussians instead of r2.max_num_gaussians = {}, because a buffer of this device has no \
                 room for more",
                config.r2.max_num_gaussians
            ));
        }
        Ok((Self::with(gpu, data, config, &R2State::fresh(rows), 0)?, notes))
    }

    /// Goes on after `step` iterations from the state they left.
    ///
    /// # Errors
    /// As [`R2Trainer::new`].
    pub fn with(gpu: &Gpu, data: R2Data, config: &Config<R2Settings>, state: &R2State, step: u32) -> Result<R2Trainer> {
        let mut config = config.clone();
        config.r2.max_num_gaussians = config.r2.max_num_gaussians.min(max_of_set(gpu, &data));
        let config = &config;
        let n = check_count(state, &data)?;
        let (setup, r2) = (gaussian_setup(&data, config), r2_setup(&data, &config.r2));
        let kernels = R2Kernels::new(gpu, config.r2.integral)?;
        let pictures = picture_setup(&data, &config.r2);
        let buffers = buffers(gpu, &data, config, (&setup, &r2, &pictures), step)?;
        let particles = R2ParticleBuffers::new(gpu, state)?;
        let per_submit = config.train.iterations_per_submit;
        let parts = R2Parts { kernels: &kernels, buffers: &buffers, particles: &particles, setup: &setup, r2: &r2, n };
        let iterations = record(gpu, parts, per_submit)?;
        let (gpu, config) = (gpu.clone(), config.clone());
        Ok(R2Trainer { gpu, data, config, setup, r2, pictures, kernels, buffers, particles, n, iterations, step })
    }

    /// Data of the run.
    pub fn data(&self) -> &R2Data {
        &self.data
    }

    /// Constants of the run.
    pub fn setups(&self) -> R2Setups<'_> {
        (&self.setup, &self.r2, &self.pictures)
    }

    /// The Gaussians on the device, for tests.
    pub fn particles(&self) -> &R2ParticleBuffers {
        &self.particles
    }

    /// Other buffers on the device, for tests.
    pub fn buffers(&self) -> &R2Buffers {
        &self.buffers
    }

    /// Adds and removes Gaussians. This is rare enough for the host, which draws children in f64.
    fn densify(&mut self) -> Result<()> {
        let (r2, n_sets) = (&self.config.r2, self.data.n_sets());
        let state = densified(&self.state()?, n_sets, r2, self.config.seed, self.step);
        self.n = check_count(&state, &self.data)?;
        self.particles = R2ParticleBuffers::new(&self.gpu, &state)?;
        self.iterations = record(&self.gpu, self.parts(), self.config.train.iterations_per_submit)?;
        Ok(())
    }

    fn parts(&self) -> R2Parts<'_> {
        let (setup, r2) = (&self.setup, &self.r2);
        R2Parts { kernels: &self.kernels, buffers: &self.buffers, particles: &self.particles, setup, r2, n: self.n }
    }
}

impl SetsFit for R2Trainer {
    type State = R2State;

    fn step(&self) -> u32 {
        self.step
    }

    fn count(&self) -> u32 {
        self.n
    }

    fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        let until = until.min(self.config.train.iterations);
        if self.step >= until {
            return Ok(Vec::new());
        }
        let first = self.step;
        let stop = (first + 1..until).find(|step| densifies(&self.config.r2, *step)).unwrap_or(until);
        self.step += self.iterations.run(&self.gpu, first, stop)?;
        let losses = losses(&self.gpu, &self.buffers.gaussian_ring, first..self.step, SMALLER_STEPS)?;
        if densifies(&self.config.r2, self.step) {
            self.densify()?;
        }
        Ok(losses)
    }

    fn state(&self) -> Result<R2State> {
        let state = self.particles.download(&self.gpu, self.n as usize)?;
        state.check(self.step)?;
        Ok(state)
    }

    fn field_of(&self, state: &R2State) -> Gaussians {
        self.data.field(&state.rows, ScaleBounds::of(&self.config.r2), self.step)
    }

    fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        // The schedule has one more row than iterations for this.
        if self.step > self.config.train.iterations {
            return Err(Error::Internal("the fit has ended, so no iteration is left to be timed".into()));
        }
        let mut recording = Recording::timed(&self.gpu, "profiled iteration of R2-Gaussian", MAX_PASSES)?;
        record_step(&mut R2Pass { recording: &mut recording, parts: self.parts() })?;
        self.step += 1;
        let times = pass_times(&self.gpu, recording)?;
        if densifies(&self.config.r2, self.step) {
            self.densify()?;
        }
        Ok(times)
    }

    /// Work of the last iteration, without voxels.
    fn work(&self) -> Result<GaussianWork> {
        let splats = (&self.particles.splats, &self.particles.image_of_splat);
        let cost = match self.config.r2.integral {
            R2Integral::Affine => SplatCost::AFFINE,
            R2Integral::Exact => SplatCost::CHORD,
        };
        GaussianWork::of(&self.gpu, &self.setup, splats, self.n, cost)
    }
}

/// Maximum number of Gaussians of a set, such that all sets fit the device's buffers.
fn max_of_set(gpu: &Gpu, data: &R2Data) -> u32 {
    gpu.info().max_storage_buffer_range / size_of::<R2Gaussian>() as u32 / data.n_sets() as u32
}

/// Returns the number of Gaussians; refuses a set without any.
fn check_count(state: &R2State, data: &R2Data) -> Result<u32> {
    let mut counts = vec![0usize; data.n_sets()];
    for g in &state.rows {
        match counts.get_mut(g.set as usize) {
            Some(count) => *count += 1,
            None => {
                return Err(Error::config(
                    "checkpoint",
                    g.set,
                    "has a set of Gaussians that does not belong to the dataset",
                ));
            }
        }
    }
    if let Some(empty) = counts.iter().position(|count| *count == 0) {
        let problem = format!(
            "no Gaussian of {} is left: the pruning threshold r2.density_min_threshold is too high, or the images are empty",
            data.sets.name(empty)
        );
        return Err(Error::unmet("r2.n_points", 0, problem));
    }
    u32::try_from(state.rows.len()).map_err(|_| Error::config("r2.n_points", state.rows.len(), "is too many Gaussians"))
}

fn buffers(
    gpu: &Gpu,
    data: &R2Data,
    config: &Config<R2Settings>,
    (setup, r2, pictures): R2Setups<'_>,
    step: u32,
) -> Result<R2Buffers> {
    let views: Vec<_> = data.views.iter().map(|view| view.to_device()).collect();
    let fill = vec![0.0; setup.image_stride as usize - data.n_pixels()];
    let targets: Vec<f32> =
        data.images.chunks(data.n_pixels()).flat_map(|image| image.iter().chain(&fill)).copied().collect();
    let new = |name: Binding, n: u64| gpu.buffer(name.name(), 4 * n, Memory::Device);
    let pixels = u64::from(setup.image_stride) * u64::from(r2.n_sets);
    let voxels = if r2.tv_weight > 0.0 { u64::from(r2.box_side).pow(3) * u64::from(r2.n_sets) } else { 4 };
    Ok(R2Buffers {
        gaussian_setup: gpu.buffer_with("gaussian_setup", &[*setup])?,
        r2_setup: gpu.buffer_with("r2_setup", &[*r2])?,
        picture_setup: gpu.buffer_with("picture_setup", &[*pictures])?,
        gaussian_views: gpu.buffer_with("gaussian_views", &views)?,
        picture_turns: gpu.buffer_with("picture_turns", &turns(data, config))?,
        r2_schedule: gpu.buffer_with("r2_schedule", &schedule(config))?,
        gaussian_step: gpu.buffer_with("gaussian_step", &[step])?,
        picture_targets: gpu.buffer_with("picture_targets", &targets)?,
        splat_images: new(Binding::splat_images, pixels)?,
        splat_image_gradient: new(Binding::splat_image_gradient, pixels)?,
        ssim_row_sums: new(Binding::ssim_row_sums, 4 * pixels)?,
        ssim_row_products: new(Binding::ssim_row_products, pixels)?,
        ssim_factors: new(Binding::ssim_factors, 4 * pixels)?,
        ssim_row_factors: new(Binding::ssim_row_factors, 4 * pixels)?,
        r2_voxel_sums: new(Binding::r2_voxel_sums, voxels)?,
        r2_voxel_gradient: new(Binding::r2_voxel_gradient, voxels)?,
        gaussian_loss_parts: new(Binding::gaussian_loss_parts, setup.n_loss_parts.into())?,
        gaussian_ring: ring(gpu, "gaussian_ring")?,
    })
}

fn record(gpu: &Gpu, parts: R2Parts<'_>, per_submit: u32) -> Result<Iterations> {
    Iterations::record(gpu, per_submit, |iterations| {
        let mut recording = Recording::new(gpu, &format!("{iterations} iterations of R2-Gaussian"))?;
        let mut pass = R2Pass { recording: &mut recording, parts };
        for _ in 0..iterations {
            record_step(&mut pass)?;
        }
        Ok(recording.finish()?)
    })
}
