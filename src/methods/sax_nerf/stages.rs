//! The stages of SAX-NeRF, their buffers, and one iteration. For each field, the stages run in this order,
//!
//! sax_batch -> sax_points -> sax_encode -> the Lineformer's layers -> sax_loss -> back through them -> sax_linear_gradient ->
//! sax_weight_gradient -> sax_encode_bwd -> sax_grid_gradient -> adam
//!
//! in buffers that all fields share except for their parameters; sax_report follows.

use crate::error::Result;
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::gpu::record::{Groups, Recording};
use crate::kernels::constants::{sax_linear, sax_linear_texel};
use crate::kernels::dispatch::{Binding, BufferSet, buffer_set, dispatch_finding};
use crate::kernels::layout::SaxSetup;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage, along_two_axes, vec4_variant};
use crate::kernels::tuning::Tuning;
use crate::methods::sax_nerf::field::SaxShape;
use crate::methods::sax_nerf::lineformer::{
    Lineformer, LineformerBackKernels, LineformerKernels, Recorder, capacity, chunks,
};
use crate::network::chunk::Chunk;

/// Pipelines that evaluate a field.
pub struct SaxFieldKernels {
    /// Samples along rays.
    pub points: Stage<push::SaxPoints>,
    /// Features of samples.
    pub encode: Stage<push::SaxEncode>,
    /// Attenuation of samples.
    pub lineformer: LineformerKernels,
    /// Number of samples per lane of the layers.
    lane_samples: u32,
    /// Rendering of rays.
    pub view: Stage<push::SaxView>,
}

impl SaxFieldKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<SaxFieldKernels> {
        let plain = Build::default();
        Ok(SaxFieldKernels {
            points: plain.stage(gpu)?,
            encode: plain.stage(gpu)?,
            lineformer: LineformerKernels::new(gpu)?,
            lane_samples: lane_samples(gpu),
            view: plain.stage(gpu)?,
        })
    }
}

/// Returns the number of samples per lane of the tiled stages on a device; forward and backward stages have the same.
fn lane_samples(gpu: &Gpu) -> u32 {
    let is_plain = vec4_variant(&Tuning::for_device(gpu.info())).is_empty();
    if is_plain { sax_linear::SAMPLES } else { sax_linear_texel::SAMPLES }
}

/// Pipelines of a fit.
pub struct SaxKernels {
    /// Pipelines that evaluate the field.
    pub field: SaxFieldKernels,
    /// Draws the rays of a batch.
    pub batch: Stage<push::SaxBatch>,
    /// Residuals.
    pub loss: Stage<push::SaxLoss>,
    /// Gradients with respect to the features, and partial gradients of the Lineformer's parameters.
    pub lineformer_bwd: LineformerBackKernels,
    /// Gradient of the Lineformer's parameters.
    pub weight_gradient: Stage<push::SaxWeightGradient>,
    /// Scatter of the features' gradient to the grid.
    pub encode_bwd: Stage<push::SaxEncodeBwd>,
    /// Gradient of the grid.
    pub grid_gradient: Stage<push::SaxGridGradient>,
    /// The optimiser.
    pub adam: Stage<push::Adam>,
    /// Loss and step count.
    pub report: Stage<push::SaxReport>,
}

impl SaxKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<SaxKernels> {
        let plain = Build::default();
        Ok(SaxKernels {
            field: SaxFieldKernels::new(gpu)?,
            batch: plain.stage(gpu)?,
            loss: plain.stage(gpu)?,
            lineformer_bwd: LineformerBackKernels::new(gpu)?,
            weight_gradient: plain.stage(gpu)?,
            encode_bwd: Build { int64: true, ..plain }.stage(gpu)?,
            grid_gradient: plain.stage(gpu)?,
            adam: plain.stage(gpu)?,
            report: plain.stage(gpu)?,
        })
    }
}

buffer_set! {
    /// Buffers for evaluating a field, except for its parameters.
    pub struct SaxSampleBuffers {
        /// [`SaxSetup`].
        sax_setup,
        /// [`crate::kernels::layout::SaxLevel`]s.
        sax_levels,
        /// [`crate::kernels::layout::DeviceState`]: iterations done.
        state,
        /// `[ray][sample]`: points of the unit cube, and their path lengths.
        sax_points,
        /// `[pair of levels][sample]`: features.
        sax_encoding,
        /// `[ray][sample]`: attenuation.
        sax_sigma,
        /// `[vector][number / 4][sample of a chunk]`: outputs of the layers.
        sax_vectors,
        /// Read-only view of `sax_vectors`.
        sax_operands,
    }
}

buffer_set! {
    /// Data and counters of a fit, beside [`SaxSampleBuffers`].
    pub struct SaxFitBuffers {
        /// [`crate::kernels::layout::Setup`] for the optimiser.
        setup,
        /// [`crate::kernels::layout::Schedule`]s.
        schedule,
        /// `[turn]`: images of the fields, in their order.
        sax_turns,
        /// [`crate::kernels::layout::View`] of each image.
        sax_views,
        /// [`crate::kernels::layout::SaxList`] of each image.
        sax_lists,
        /// Pixels that show something.
        sax_listed,
        /// `[image][pixel]`: target line integrals.
        sax_images,
        /// [`crate::kernels::layout::Ray`]s of a batch.
        rays,
        /// `[ray]`: gradient of the loss.
        sax_ray_gradient,
        /// `[field][ray]`: loss.
        sax_losses,
        /// [`crate::kernels::layout::SaxProduct`]s.
        sax_products,
        /// `[part of a chunk][parameter]`: partial gradients.
        sax_weight_parts,
        /// `[pair of levels][sample]`: gradient with respect to the features.
        sax_encoding_gradient,
        /// `[parameter]`: sums of the grid's gradient in fixed point.
        sax_grid_sums,
        /// `[parameter]`: gradient of a field.
        gradient,
        /// Losses of the last iterations.
        sax_ring,
    }
}

/// Parameters of a field on the device, and their moments.
#[derive(Clone)]
pub struct SaxSetBuffers {
    /// The parameters.
    pub params: Buffer,
    /// First and second moments.
    pub moments: Buffer,
    /// Seed of its random numbers.
    pub seed: u32,
    /// Index of its first image among the turns, and number of its images.
    pub turns: (u32, u32),
}

/// Records the evaluation of a field at the samples of rays.
pub struct SaxSampling<'a> {
    /// The stages.
    pub kernels: &'a SaxFieldKernels,
    /// Buffers of the stages.
    pub buffers: &'a SaxSampleBuffers,
    /// Constants on the host.
    pub setup: &'a SaxSetup,
    /// Sizes of the field.
    pub shape: SaxShape,
    /// Parameters of the field.
    pub params: &'a Buffer,
    /// Rays.
    pub rays: &'a Buffer,
}

impl SaxSampling<'_> {
    fn run<P: PushConstants>(
        &self,
        recording: &mut Recording,
        stage: &Stage<P>,
        groups: Groups<'_>,
        push: P,
        out: Option<&Buffer>,
    ) -> Result<()> {
        let mut bound = vec![(Binding::sax_params, self.params.into()), (Binding::rays, self.rays.into())];
        bound.extend(out.map(|out| (Binding::sax_sigma, out.into())));
        dispatch_finding(recording, stage, groups, &bound, |name| self.buffers.find(name), push)
    }

    /// Records attenuation at the samples of `n_rays` rays from `first_ray` on, times `scale`: into `out` from number
    /// `first_out` on, or into the buffers' own.
    ///
    /// # Errors
    /// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
    pub fn record(
        &self,
        recording: &mut Recording,
        seed: u32,
        Chunk { first_ray, n_rays }: Chunk,
        scale: f32,
        out: Option<(&Buffer, u32)>,
    ) -> Result<()> {
        let (kernels, row) = (self.kernels, self.setup.n_samples);
        let n_samples = n_rays * row;
        let push = push::SaxPoints { seed, first_ray, n_rays };
        self.run(recording, &kernels.points, kernels.points.groups_over(n_samples), push, None)?;
        let groups = kernels.encode.groups_over(n_samples * (self.setup.n_levels / 2));
        self.run(recording, &kernels.encode, groups, push::SaxEncode { n_samples }, None)?;
        let (target, first_out) = (out.map(|(buffer, _)| buffer), out.map_or(0, |(_, first)| first));
        for chunk in chunks(n_rays, row) {
            let lineformer =
                Lineformer { shape: self.shape, capacity: capacity(n_samples), n_all: n_samples, row, chunk };
            let mut run = Sampled { sampling: self, recording, out: target };
            lineformer.layers(&mut run, &kernels.lineformer)?;
            lineformer.density(&mut run, &kernels.lineformer, first_out + chunk.first, scale)?;
        }
        Ok(())
    }
}

/// Recorder of the Lineformer's layers for evaluating a field.
struct Sampled<'a, 'b> {
    sampling: &'b SaxSampling<'a>,
    recording: &'b mut Recording,
    out: Option<&'b Buffer>,
}

impl Recorder for Sampled<'_, '_> {
    fn run<P: PushConstants>(&mut self, stage: &Stage<P>, groups: Groups<'_>, push: P) -> Result<()> {
        self.sampling.run(self.recording, stage, groups, push, self.out)
    }

    fn lane_samples(&self) -> u32 {
        self.sampling.kernels.lane_samples
    }
}

/// A recording of a fit's stages.
pub struct SaxPass<'a> {
    /// Recording that the stages are added to.
    pub recording: &'a mut Recording,
    /// The stages.
    pub kernels: &'a SaxKernels,
    /// Buffers of the samples.
    pub samples: &'a SaxSampleBuffers,
    /// Data and counters of the fit.
    pub fit: &'a SaxFitBuffers,
    /// The fields.
    pub sets: &'a [SaxSetBuffers],
    /// Sizes of a field.
    pub shape: SaxShape,
    /// Constants on the host.
    pub setup: &'a SaxSetup,
}

impl SaxPass<'_> {
    fn run<P: PushConstants>(
        &mut self,
        set: &SaxSetBuffers,
        stage: &Stage<P>,
        groups: Groups<'_>,
        push: P,
    ) -> Result<()> {
        let (samples, fit) = (self.samples, self.fit);
        let bound = [
            (Binding::sax_params, (&set.params).into()),
            (Binding::params, (&set.params).into()),
            (Binding::moments, (&set.moments).into()),
        ];
        dispatch_finding(
            self.recording,
            stage,
            groups,
            &bound,
            |name| samples.find(name).or_else(|| fit.find(name)),
            push,
        )
    }

    /// Records the line integrals of a batch of a field, and their loss.
    fn forward(&mut self, index: u32, set: &SaxSetBuffers) -> Result<()> {
        let (kernels, n_rays) = (self.kernels, self.setup.n_rays);
        let (first_turn, n_turns) = set.turns;
        let push = push::SaxBatch { seed: set.seed, first_turn, n_turns };
        self.run(set, &kernels.batch, kernels.batch.groups_for(n_rays), push)?;
        let sampling = SaxSampling {
            kernels: &kernels.field,
            buffers: self.samples,
            setup: self.setup,
            shape: self.shape,
            params: &set.params,
            rays: &self.fit.rays,
        };
        sampling.record(self.recording, set.seed, Chunk { first_ray: 0, n_rays }, 1.0, None)?;
        let push = push::SaxLoss { first_loss: index * n_rays };
        self.run(set, &kernels.loss, along_two_axes(n_rays), push)
    }

    /// Records the gradient of that loss with respect to the Lineformer's parameters and the features.
    fn backward(&mut self, set: &SaxSetBuffers) -> Result<()> {
        let (kernels, setup, shape) = (self.kernels, self.setup, self.shape);
        let (row, n_all) = (setup.n_samples, setup.n_rays * setup.n_samples);
        let all = chunks(setup.n_rays, row);
        for (index, chunk) in all.iter().enumerate() {
            let lineformer = Lineformer { shape, capacity: capacity(n_all), n_all, row, chunk: *chunk };
            let mut run = Fitted { pass: &mut *self, set };
            if all.len() > 1 {
                // The buffer holds the vectors of another chunk.
                lineformer.layers(&mut run, &kernels.field.lineformer)?;
            }
            lineformer.backward(&mut run, &kernels.lineformer_bwd)?;
            lineformer.gradient(&mut run, &kernels.lineformer_bwd, setup.n_groups, index > 0)?;
        }
        let weights = &kernels.weight_gradient;
        self.run(set, weights, weights.groups_over(setup.n_weights), push::SaxWeightGradient {})
    }

    /// Records the gradient of the grid from that of the features, as sums in fixed point.
    ///
    /// # Errors
    /// Errors of [`record_step`].
    pub fn scatter(&mut self, set: &SaxSetBuffers) -> Result<()> {
        let (kernels, n_samples) = (self.kernels, self.setup.n_rays * self.setup.n_samples);
        let groups = kernels.encode_bwd.groups_over(n_samples * (self.setup.n_levels / 2));
        self.run(set, &kernels.encode_bwd, groups, push::SaxEncodeBwd { n_samples })
    }

    /// Records the gradient of the grid from these sums, which it resets to zero, and the update of all parameters.
    fn update(&mut self, set: &SaxSetBuffers) -> Result<()> {
        let (kernels, setup) = (self.kernels, self.setup);
        let grid = &kernels.grid_gradient;
        self.run(set, grid, grid.groups_over(setup.n_grid), push::SaxGridGradient {})?;
        let n_params = setup.n_weights + setup.n_grid;
        self.run(set, &kernels.adam, kernels.adam.groups_over(n_params), push::Adam {})
    }
}

/// Recorder of the Lineformer's layers for a fit.
struct Fitted<'a, 'b> {
    pass: &'b mut SaxPass<'a>,
    set: &'b SaxSetBuffers,
}

impl Recorder for Fitted<'_, '_> {
    fn run<P: PushConstants>(&mut self, stage: &Stage<P>, groups: Groups<'_>, push: P) -> Result<()> {
        self.pass.run(self.set, stage, groups, push)
    }

    fn lane_samples(&self) -> u32 {
        self.pass.kernels.field.lane_samples
    }
}

/// Records one iteration, which uses one image of each field.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_step(pass: &mut SaxPass<'_>) -> Result<()> {
    let sets = pass.sets;
    for (index, set) in (0..).zip(sets) {
        pass.forward(index, set)?;
        pass.backward(set)?;
        pass.scatter(set)?;
        pass.update(set)?;
    }
    let report = &pass.kernels.report;
    pass.run(&sets[0], report, Groups::Direct([1, 1, 1]), push::SaxReport {})
}

/// Records the rendering of a chunk of the rays of a view, from the attenuations at their samples.
///
/// # Errors
/// Errors of [`record_step`].
pub fn record_view(
    recording: &mut Recording,
    sampling: &SaxSampling<'_>,
    ray_out: &Buffer,
    Chunk { first_ray, n_rays }: Chunk,
) -> Result<()> {
    let stage = &sampling.kernels.view;
    let bound = [(Binding::ray_out, ray_out.into())];
    let push = push::SaxView { first_ray, n_rays };
    dispatch_finding(recording, stage, along_two_axes(n_rays), &bound, |name| sampling.buffers.find(name), push)
}
