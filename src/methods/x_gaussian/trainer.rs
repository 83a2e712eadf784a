//! Fits Gaussians as X-Gaussian does: all sets at once, one view each per iteration, and density control on the host.

use crate::config::Config;
use crate::config::sections::XSettings;
use crate::error::{Error, Result};
use crate::fitting::iterations::{Iterations, pass_times};
use crate::fitting::ring::{counts_wrongly, losses, ring};
use crate::fitting::shown::SetsFit;
use crate::gaussians::blending::particles::BlendedGaussians;
use crate::gaussians::blending::picture::{first_capacity, more_capacity};
use crate::gaussians::blending::stages::BlendBuffers;
use crate::gaussians::field::Gaussians;
use crate::gaussians::work::GaussianWork;
use crate::gpu::buffer::Memory;
use crate::gpu::device::Gpu;
use crate::gpu::record::{PassTime, Recording};
use crate::kernels::dispatch::Binding;
use crate::kernels::layout::{
    BlendCounts, BlendEnd, BlendGaussian, BlendList, BlendSetup, GaussianSetup, PictureSetup, XStatus,
};
use crate::methods::x_gaussian::data::XData;
use crate::methods::x_gaussian::densify::{densified, densifies, resets};
use crate::methods::x_gaussian::particles::{SUMS, XLearningBuffers, download};
use crate::methods::x_gaussian::setup::{blend_setup, comparing_setup, gaussian_setup, schedule, turns};
use crate::methods::x_gaussian::stages::{XFitBuffers, XKernels, XParts};
use crate::methods::x_gaussian::start::first_state;
use crate::methods::x_gaussian::state::{SMALLER_STEPS, XState};

/// Maximum number of passes of a timed iteration: a sort has dozens.
const MAX_PASSES: u32 = 128;
/// Pixels of a tile.
const TILE_PIXELS: u64 = 256;
/// Operations per pair of a Gaussian in a tile's list and a pixel of that tile, forward and backward; an exponential
/// counts as one.
const FLOP_PER_PAIR: u64 = 62;
/// Bytes per entry of a list: the Gaussian read twice as it is seen, its sums written and read.
const BYTES_PER_ENTRY: u64 = 2 * 40 + 2 * 4 * SUMS as u64;
/// Bytes per Gaussian: as it is seen and its keys in each pass of the sort, written and read.
const BYTES_PER_GAUSSIAN: u64 = 2 * 48 + 8 * 3 * 8;

/// A run on a device.
pub struct XTrainer {
    gpu: Gpu,
    data: XData,
    config: Config<XSettings>,
    setup: GaussianSetup,
    x: BlendSetup,
    kernels: XKernels,
    scene: BlendBuffers,
    fit: XFitBuffers,
    seen: BlendedGaussians,
    learning: XLearningBuffers,
    /// The set of each Gaussian.
    sets: Vec<u32>,
    iterations: Option<Iterations>,
    step: u32,
}

impl XTrainer {
    /// Begins where the settings say; returns the run, and notes about its beginning for the user.
    ///
    /// # Errors
    /// [`Error::Config`] for impossible settings; device errors.
    pub fn new(gpu: &Gpu, data: XData, config: &Config<XSettings>) -> Result<(XTrainer, Vec<String>)> {
        let state = first_state(&data, &config.x);
        let (max, mut notes) = (max_of_set(gpu, &data), Vec::new());
        if max < config.x.max_gaussians {
            notes.push(format!(
                "a set has at most {max} Gaussians instead of x.max_gaussians = {}, because a buffer of this device has no \
                 room for more",
                config.x.max_gaussians
            ));
        }
        Ok((Self::with(gpu, data, config, &state, 0)?, notes))
    }

    /// Goes on after `step` iterations from the state they left.
    ///
    /// # Errors
    /// As [`XTrainer::new`].
    pub fn with(gpu: &Gpu, data: XData, config: &Config<XSettings>, state: &XState, step: u32) -> Result<XTrainer> {
        let mut config = config.clone();
        config.x.max_gaussians = config.x.max_gaussians.min(max_of_set(gpu, &data));
        let n = check_count(state, &data, config.x.min_opacity)?;
        let setup = gaussian_setup(&data, &config);
        let capacity = first_capacity(n, capacity_limit(gpu));
        let x = blend_setup(&config.x, data.n_sets() as u32, [setup.width, setup.height], capacity);
        let kernels = XKernels::new(gpu)?;
        let scene = scene_buffers(gpu, &data, &config, (&setup, &x), step)?;
        let fit = fit_buffers(gpu, &data, &config, &setup)?;
        let seen = BlendedGaussians::new(gpu, &state.rows, &state.sets, data.n_sets(), x.capacity)?;
        let learning = XLearningBuffers::new(gpu, state, x.capacity)?;
        let (gpu, sets) = (gpu.clone(), state.sets.clone());
        let iterations = None;
        Ok(XTrainer { gpu, data, config, setup, x, kernels, scene, fit, seen, learning, sets, iterations, step })
    }

    /// Data of the run.
    pub fn data(&self) -> &XData {
        &self.data
    }

    /// Constants of the run.
    pub fn setups(&self) -> (&GaussianSetup, &BlendSetup) {
        (&self.setup, &self.x)
    }

    /// Constants of the stages that compare pictures.
    pub fn comparing_setup(&self) -> PictureSetup {
        comparing_setup(&self.data, &self.config.x)
    }

    /// The Gaussians on the device, for tests.
    pub fn particles(&self) -> (&BlendedGaussians, &XLearningBuffers) {
        (&self.seen, &self.learning)
    }

    /// Other buffers on the device, for tests.
    pub fn buffers(&self) -> (&BlendBuffers, &XFitBuffers) {
        (&self.scene, &self.fit)
    }

    fn parts(&self) -> XParts<'_> {
        XParts {
            kernels: &self.kernels,
            scene: &self.scene,
            fit: &self.fit,
            seen: &self.seen,
            learning: &self.learning,
            setup: &self.setup,
            x: &self.x,
            n: self.count(),
        }
    }

    /// Gives lists room for `capacity` Gaussians, less or more than they have: for tests.
    ///
    /// # Errors
    /// Device errors.
    pub fn set_capacity(&mut self, capacity: u32) -> Result<()> {
        self.x.capacity = capacity;
        self.gpu.upload(&self.scene.blend_setup, 0, &[self.x])?;
        self.seen.make_room(&self.gpu, capacity)?;
        self.learning.make_room(&self.gpu, capacity)?;
        self.iterations = None;
        Ok(())
    }

    /// Tells whether the last iterations had room for their lists; if not, they did nothing, and there is more room now.
    fn had_room(&mut self) -> Result<bool> {
        let mut status = [XStatus::default()];
        self.fit.x_status.read(&mut status)?;
        self.step = status[0].step;
        let had_room = status[0].entries <= self.x.capacity;
        if !had_room {
            self.set_capacity(more_capacity(
                status[0].entries,
                capacity_limit(&self.gpu),
                ("x.max_gaussians", self.config.x.max_gaussians.into()),
                "smaller pictures, a larger x.interval, or x.static_data = \"pooled\"",
            )?)?;
        }
        Ok(had_room)
    }

    /// Error for a device that does not count its iterations, which would be asked for them for ever.
    fn counts_wrongly(&self, first: u32, stop: u32) -> Error {
        let step = self.step;
        counts_wrongly(
            &self.gpu,
            &format!("was to execute iterations from {first} to at most {stop}, and reports iteration {step}"),
        )
    }

    fn run(&mut self, stop: u32) -> Result<()> {
        loop {
            if self.iterations.is_none() {
                let (gpu, per_submit) = (&self.gpu, self.config.train.iterations_per_submit);
                self.iterations = Some(record(gpu, self.parts(), per_submit)?);
            }
            let first = self.step;
            if let Some(iterations) = &self.iterations {
                iterations.run(&self.gpu, first, stop)?;
            }
            let had_room = self.had_room()?;
            // Of several, the first may have had room.
            if (first + 1..=stop).contains(&self.step) {
                return Ok(());
            }
            if had_room {
                return Err(self.counts_wrongly(first, stop));
            }
        }
    }

    fn changes(&self, step: u32) -> bool {
        densifies(&self.config.x, step) || resets(&self.config.x, step)
    }

    /// Adds and removes Gaussians, and resets opacities, where it is time. This is rare enough for the host, which draws
    /// children in f64.
    fn control_density(&mut self) -> Result<()> {
        if !self.changes(self.step) {
            return Ok(());
        }
        let (x, at) = (&self.config.x, (self.config.seed, self.step));
        let mut state = self.state()?;
        if densifies(x, self.step) {
            state = densified(&state, self.data.n_sets(), x, self.data.extent_mm, at);
        }
        if resets(x, self.step) {
            state.reset_opacities(x.reset_opacity);
        }
        check_count(&state, &self.data, self.config.x.min_opacity)?;
        self.seen = BlendedGaussians::new(&self.gpu, &state.rows, &state.sets, self.data.n_sets(), self.x.capacity)?;
        self.learning = XLearningBuffers::new(&self.gpu, &state, self.x.capacity)?;
        self.sets = state.sets;
        self.iterations = None;
        Ok(())
    }
}

impl SetsFit for XTrainer {
    type State = XState;

    fn step(&self) -> u32 {
        self.step
    }

    fn count(&self) -> u32 {
        self.sets.len() as u32
    }

    fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        let until = until.min(self.config.train.iterations);
        if self.step >= until {
            return Ok(Vec::new());
        }
        let first = self.step;
        let stop = (first + 1..until).find(|step| self.changes(*step)).unwrap_or(until);
        self.run(stop)?;
        let losses = losses(&self.gpu, &self.fit.gaussian_ring, first..self.step, SMALLER_STEPS)?;
        self.control_density()?;
        Ok(losses)
    }

    fn state(&self) -> Result<XState> {
        let state = download(&self.gpu, &self.seen, &self.learning, &self.sets)?;
        state.check(self.step)?;
        Ok(state)
    }

    fn field_of(&self, state: &XState) -> Gaussians {
        self.data.field(state, self.step)
    }

    fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        // The schedule has one more row than iterations for this.
        if self.step > self.config.train.iterations {
            return Err(Error::Internal("the fit has ended, so no iteration is left to be timed".into()));
        }
        loop {
            let mut recording = Recording::timed(&self.gpu, "profiled iteration of X-Gaussian", MAX_PASSES)?;
            self.parts().record_step(&mut recording)?;
            let times = pass_times(&self.gpu, recording)?;
            if self.had_room()? {
                self.control_density()?;
                return Ok(times);
            }
        }
    }

    /// Work of the last iteration: pairs of a Gaussian in a tile's list and a pixel of that tile.
    fn work(&self) -> Result<GaussianWork> {
        let mut status = [XStatus::default()];
        self.fit.x_status.read(&mut status)?;
        let (splats, entries) = (u64::from(self.count()), u64::from(status[0].entries));
        let pairs = TILE_PIXELS * entries;
        Ok(GaussianWork {
            splats,
            pairs,
            gflop: (FLOP_PER_PAIR * pairs) as f64 * 1e-9,
            megabytes: (BYTES_PER_ENTRY * entries + BYTES_PER_GAUSSIAN * splats) as f64 * 1e-6,
        })
    }
}

/// Maximum number of Gaussians of a set, such that all sets fit the device's buffers.
fn max_of_set(gpu: &Gpu, data: &XData) -> u32 {
    gpu.info().max_storage_buffer_range / size_of::<BlendGaussian>() as u32 / data.n_sets() as u32
}

/// Maximum number of list entries whose gradients a buffer holds.
fn capacity_limit(gpu: &Gpu) -> u32 {
    gpu.info().max_storage_buffer_range / (size_of::<f32>() as u32 * SUMS)
}

/// Returns the number of Gaussians; refuses a set without any.
fn check_count(state: &XState, data: &XData, weakest: f64) -> Result<u32> {
    if let Some(bad) = state.sets.iter().find(|set| **set as usize >= data.n_sets()) {
        return Err(Error::config("checkpoint", bad, "has a set of Gaussians that does not belong to the dataset"));
    }
    if let Some(empty) = state.counts(data.n_sets()).iter().position(|count| *count == 0) {
        let problem = format!(
            "no Gaussian of {} is left: the pruning threshold x.min_opacity is too high, or the images are empty",
            data.sets.name(empty)
        );
        return Err(Error::config("x.min_opacity", weakest, problem));
    }
    u32::try_from(state.rows.len())
        .map_err(|_| Error::config("x.max_gaussians", state.rows.len(), "is too many Gaussians"))
}

fn scene_buffers(
    gpu: &Gpu,
    data: &XData,
    config: &Config<XSettings>,
    (setup, x): (&GaussianSetup, &BlendSetup),
    step: u32,
) -> Result<BlendBuffers> {
    let views: Vec<_> = data.views.iter().map(|view| view.to_device()).collect();
    let new = |name: Binding, bytes: u64| gpu.buffer(name.name(), bytes, Memory::Device);
    let n_tiles = u64::from(x.tile_columns) * u64::from(x.tile_rows) * u64::from(x.n_sets);
    let pixels = u64::from(setup.image_stride) * u64::from(x.n_sets);
    Ok(BlendBuffers {
        gaussian_setup: gpu.buffer_with("gaussian_setup", &[*setup])?,
        blend_setup: gpu.buffer_with("blend_setup", &[*x])?,
        gaussian_views: gpu.buffer_with("gaussian_views", &views)?,
        picture_turns: gpu.buffer_with("picture_turns", &turns(data, config))?,
        gaussian_step: gpu.buffer_with("gaussian_step", &[step])?,
        blend_tile_counts: new(Binding::blend_tile_counts, 4 * n_tiles)?,
        blend_counts: new(Binding::blend_counts, size_of::<BlendCounts>() as u64)?,
        blend_lists: new(Binding::blend_lists, size_of::<BlendList>() as u64 * n_tiles)?,
        splat_images: new(Binding::splat_images, 4 * pixels)?,
        blend_ends: new(Binding::blend_ends, size_of::<BlendEnd>() as u64 * pixels)?,
    })
}

fn fit_buffers(gpu: &Gpu, data: &XData, config: &Config<XSettings>, setup: &GaussianSetup) -> Result<XFitBuffers> {
    let fill = vec![0.0; setup.image_stride as usize - data.n_pixels()];
    let targets: Vec<f32> =
        data.images.chunks(data.n_pixels()).flat_map(|image| image.iter().chain(&fill)).copied().collect();
    let new = |name: Binding, n: u64| gpu.buffer(name.name(), 4 * n, Memory::Device);
    let pixels = u64::from(setup.image_stride) * data.n_sets() as u64;
    Ok(XFitBuffers {
        picture_setup: gpu.buffer_with("picture_setup", &[comparing_setup(data, &config.x)])?,
        x_schedule: gpu.buffer_with("x_schedule", &schedule(config, data.extent_mm))?,
        picture_targets: gpu.buffer_with("picture_targets", &targets)?,
        splat_image_gradient: new(Binding::splat_image_gradient, pixels)?,
        ssim_row_sums: new(Binding::ssim_row_sums, 4 * pixels)?,
        ssim_row_products: new(Binding::ssim_row_products, pixels)?,
        ssim_factors: new(Binding::ssim_factors, 4 * pixels)?,
        ssim_row_factors: new(Binding::ssim_row_factors, 4 * pixels)?,
        gaussian_loss_parts: new(Binding::gaussian_loss_parts, setup.n_loss_parts.into())?,
        gaussian_ring: ring(gpu, "gaussian_ring")?,
        x_status: gpu.buffer("x_status", size_of::<XStatus>() as u64, Memory::Readback)?,
    })
}

fn record(gpu: &Gpu, parts: XParts<'_>, per_submit: u32) -> Result<Iterations> {
    Iterations::record(gpu, per_submit, |iterations| {
        let mut recording = Recording::new(gpu, &format!("{iterations} iterations of X-Gaussian"))?;
        for _ in 0..iterations {
            parts.record_step(&mut recording)?;
        }
        Ok(recording.finish()?)
    })
}
