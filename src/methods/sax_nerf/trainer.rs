//! Fits all fields of SAX-NeRF together: each iteration uses one image of each field.

use crate::config::Config;
use crate::config::sections::SaxSettings;
use crate::error::{Error, Result};
use crate::fitting::fit::{Advance, FieldFeed, Fit, FitField, FitProgress, Iterates, Measured, PendingFit, SavedFit};
use crate::fitting::iterations::{Iterations, pass_times};
use crate::fitting::losses::StepLoss;
use crate::fitting::ring::losses;
use crate::fitting::sets::seed_of_set;
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::{PassTime, Recording};
use crate::kernels::layout::SaxSetup;
use crate::methods::sax_nerf::buffers::{Passes, SaxMemory, fit_buffers, sample_buffers, set_buffers};
use crate::methods::sax_nerf::data::SaxData;
use crate::methods::sax_nerf::field::{SMALLER_STEPS, SaxField, SaxState, check_params};
use crate::methods::sax_nerf::lineformer::chunks;
use crate::methods::sax_nerf::setup::{fit_setup, outline};
use crate::methods::sax_nerf::stages::{
    SaxFitBuffers, SaxKernels, SaxPass, SaxSampleBuffers, SaxSetBuffers, record_step,
};
use crate::methods::sax_nerf::start::first_params;
use std::sync::Arc;

/// Maximum number of passes of an iteration of a field, and of all fields together, without those over chunks of samples.
const MAX_PASSES: u32 = 16;
/// Maximum number of passes over a chunk: forward, and forward and backward.
const CHUNK_PASSES: u32 = 40;

/// A run on a device.
pub struct SaxTrainer {
    gpu: Gpu,
    data: SaxData,
    config: Config<SaxSettings>,
    /// The field without its parameters.
    outline: SaxField,
    setup: SaxSetup,
    kernels: SaxKernels,
    samples: SaxSampleBuffers,
    fit: SaxFitBuffers,
    sets: Vec<SaxSetBuffers>,
    iterations: Iterations,
    step: u32,
}

impl SaxTrainer {
    /// Begins a fit with random parameters.
    ///
    /// # Errors
    /// [`Error::Config`] for impossible settings, and for a device that has too little memory; device errors.
    pub fn new(gpu: &Gpu, data: SaxData, config: &Config<SaxSettings>) -> Result<SaxTrainer> {
        let outline = outline(&data, &config.sax, 0);
        // The check comes before millions of random numbers are drawn.
        SaxMemory::of(&fit_setup(&outline, &data, &config.sax)).check(gpu, config, data.n_sets())?;
        let shape = outline.shape;
        let params = (0..data.n_sets()).map(|set| first_params(shape, seed_of_set(config.seed, set))).collect();
        let moments = vec![vec![[0.0; 2]; shape.n_params()]; data.n_sets()];
        Self::with(gpu, data, config, &SaxField { params, ..outline }, &SaxState { moments })
    }

    /// Resumes a fit from a field and its state, after the number of iterations that the field states.
    ///
    /// # Errors
    /// Errors of [`SaxTrainer::new`]; [`Error::Config`] for a field of other sizes.
    pub fn with(
        gpu: &Gpu,
        data: SaxData,
        config: &Config<SaxSettings>,
        field: &SaxField,
        state: &SaxState,
    ) -> Result<SaxTrainer> {
        let outline = outline(&data, &config.sax, field.step);
        let n = outline.shape.n_params();
        if field.shape != outline.shape
            || field.params.len() != data.n_sets()
            || state.moments.len() != data.n_sets()
            || field.params.iter().any(|set| set.len() != n)
            || state.moments.iter().any(|set| set.len() != n)
        {
            return Err(Error::config(
                "checkpoint",
                field.n_sets,
                "has another number of SAX-NeRF fields than the dataset needs",
            ));
        }
        let setup = fit_setup(&outline, &data, &config.sax);
        SaxMemory::of(&setup).check(gpu, config, data.n_sets())?;
        let kernels = SaxKernels::new(gpu)?;
        let samples = sample_buffers(gpu, &outline, &setup, setup.n_rays * setup.n_samples, Passes::Fitting)?;
        let fit = fit_buffers(gpu, &data, &outline, &setup, config)?;
        let sets = set_buffers(gpu, &data, field, state, config.seed)?;
        let iterations = Iterations::record(gpu, config.train.iterations_per_submit, |iterations| {
            let mut recording = Recording::new(gpu, &format!("{iterations} iterations of SAX-NeRF"))?;
            for _ in 0..iterations {
                let recording = &mut recording;
                let (kernels, samples, fit) = (&kernels, &samples, &fit);
                let shape = outline.shape;
                record_step(&mut SaxPass { recording, kernels, samples, fit, sets: &sets, shape, setup: &setup })?;
            }
            Ok(recording.finish()?)
        })?;
        let (gpu, config, step) = (gpu.clone(), config.clone(), field.step);
        Ok(SaxTrainer { gpu, data, config, outline, setup, kernels, samples, fit, sets, iterations, step })
    }

    /// Returns the number of iterations done.
    pub fn step(&self) -> u32 {
        self.step
    }

    /// Returns the data of the run.
    pub fn data(&self) -> &SaxData {
        &self.data
    }

    /// Returns the constants of the run.
    pub fn setup(&self) -> &SaxSetup {
        &self.setup
    }

    /// Returns the buffers of samples and of the fit, for tests.
    pub fn buffers(&self) -> (&SaxSampleBuffers, &SaxFitBuffers) {
        (&self.samples, &self.fit)
    }

    /// Returns the fields on the device, for tests.
    pub fn sets(&self) -> &[SaxSetBuffers] {
        &self.sets
    }

    /// Returns the parameters of the fields on the device, for drawing.
    pub fn params(&self) -> Vec<Buffer> {
        self.sets.iter().map(|set| set.params.clone()).collect()
    }

    /// Returns the field without its parameters.
    pub fn outline(&self) -> SaxField {
        SaxField { step: self.step, ..self.outline.clone() }
    }

    /// Runs one submit of iterations towards `until` and returns their losses, each the mean over the fields. The list is empty
    /// when `until` was reached before.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite; device errors.
    pub fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        let until = until.min(self.config.train.iterations);
        if self.step >= until {
            return Ok(Vec::new());
        }
        let first = self.step;
        self.step += self.iterations.run(&self.gpu, first, until)?;
        losses(&self.gpu, &self.fit.sax_ring, first..self.step, SMALLER_STEPS)
    }

    /// Returns the fields after the iterations done, and the state that a resumed run needs beside them.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a number is not finite; device errors.
    pub fn state(&self) -> Result<(SaxField, SaxState)> {
        let n = self.outline.shape.n_params();
        let params: Vec<Vec<f32>> =
            self.sets.iter().map(|set| self.gpu.download(&set.params, 0, n)).collect::<std::result::Result<_, _>>()?;
        check_params(&params, self.step)?;
        let moments =
            self.sets.iter().map(|set| self.gpu.download(&set.moments, 0, n)).collect::<std::result::Result<_, _>>()?;
        Ok((SaxField { params, ..self.outline() }, SaxState { moments }))
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// [`Error::Internal`] when the fit is over; device errors.
    pub fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        // The schedule has one row more than there are iterations, for this iteration.
        if self.step > self.config.train.iterations {
            return Err(Error::Internal("the fit has ended, so no iteration is left to be timed".into()));
        }
        let n_chunks = chunks(self.setup.n_rays, self.setup.n_samples).len() as u32;
        let max_passes = (MAX_PASSES + CHUNK_PASSES * n_chunks) * (self.setup.n_sets + 1);
        let mut recording = Recording::timed(&self.gpu, "profiled iteration of SAX-NeRF", max_passes)?;
        record_step(&mut self.pass(&mut recording))?;
        self.step += 1;
        pass_times(&self.gpu, recording)
    }

    /// Returns a pass that records stages of this fit into `recording`.
    pub fn pass<'a>(&'a self, recording: &'a mut Recording) -> SaxPass<'a> {
        let (kernels, samples, fit) = (&self.kernels, &self.samples, &self.fit);
        let shape = self.outline.shape;
        SaxPass { recording, kernels, samples, fit, sets: &self.sets, shape, setup: &self.setup }
    }
}

impl Iterates for SaxTrainer {
    fn progress(&self) -> FitProgress {
        FitProgress::at(self.step)
    }

    fn advance(&mut self, until: u32) -> Result<Advance> {
        let first = self.step + 1;
        let losses = SaxTrainer::advance(self, until)?;
        let attenuation = self.data.attenuation;
        let losses = losses.into_iter().zip(first..);
        Ok(Advance::of(losses.map(|(loss, step)| StepLoss::of_images(step, loss, attenuation)).collect()))
    }
}

impl Fit for SaxTrainer {
    fn outline(&self) -> FitField {
        FitField::of_own(Arc::new(SaxTrainer::outline(self)))
    }

    fn feed(&self) -> FieldFeed {
        FieldFeed { own: self.params(), ..FieldFeed::default() }
    }

    fn snapshot(&self) -> Result<PendingFit> {
        let (field, state) = SaxTrainer::state(self)?;
        Ok(Box::new(|| Ok(SavedFit { field: FitField::of_own(Arc::new(field)), state: Arc::new(state) })))
    }

    fn measured(&mut self) -> Option<&mut dyn Measured> {
        Some(self)
    }
}

impl Measured for SaxTrainer {
    fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        SaxTrainer::profile_step(self)
    }
}
