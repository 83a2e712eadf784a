//! The stages of a deformable set: an iteration over all phases, and an iteration that tracks the grid at a single phase.

use crate::error::Result;
use crate::gaussians::field::basis;
use crate::gaussians::particles::{MOMENTS_BYTES, ParticleBuffers, retain_marked};
use crate::gaussians::stages::{GaussianPass, TargetBuffers};
use crate::gpu::buffer::Memory;
use crate::gpu::device::Gpu;
use crate::gpu::record::Groups;
use crate::kernels::constants;
use crate::kernels::dispatch::{Binding, BufferSet, buffer_set};
use crate::kernels::layout::MotionGridSetup;
use crate::kernels::push::{self, PushConstants};
use crate::kernels::stages::{Build, Stage};
use crate::methods::dynamic_gaussians::deformable::filling::{FILLING_RATE, FillingBuffers, MIN_FILLING};
use std::ops::Range;

/// Pipelines of the deformable set, beside those of [`crate::gaussians::stages::GaussianKernels`].
pub struct DeformableKernels {
    /// Projection of the Gaussians into every view at some phases.
    pub project: Stage<push::DeformableProject>,
    /// Gradients of shapes and positions.
    pub gradient: Stage<push::DeformableGradient>,
    /// The optimiser on Gaussians and their own motion.
    pub update: Stage<push::DeformableUpdate>,
    /// Gradient of the grid.
    pub grid_gradient: Stage<push::DeformableGridGradient>,
    /// The optimiser on the grid.
    pub grid_update: Stage<push::DeformableGridUpdate>,
    /// Initial guess of the grid for tracking.
    pub guess: Stage<push::DeformableGuess>,
    /// Filling of splats, where contrast comes or goes.
    pub fill: Stage<push::DeformableFill>,
    /// Gradient of the filling, and the optimiser on it.
    pub filling: Stage<push::DeformableFilling>,
}

impl DeformableKernels {
    /// Builds the pipelines.
    ///
    /// # Errors
    /// Errors of [`Gpu::pipeline`].
    pub fn new(gpu: &Gpu) -> Result<DeformableKernels> {
        let plain = Build::default();
        Ok(DeformableKernels {
            project: plain.stage(gpu)?,
            gradient: plain.stage(gpu)?,
            update: plain.stage(gpu)?,
            grid_gradient: plain.stage(gpu)?,
            grid_update: plain.stage(gpu)?,
            guess: plain.stage(gpu)?,
            fill: plain.stage(gpu)?,
            filling: plain.stage(gpu)?,
        })
    }
}

buffer_set! {
    /// Motion that all Gaussians share: displacements of a grid.
    pub struct GridBuffers {
        /// [`MotionGridSetup`].
        deformable_setup,
        /// `[phase][basis function]`.
        motion_basis,
        /// `[phase][node]`: displacement.
        motion_grid,
        /// First moments of Adam, in the same layout.
        motion_grid_first,
        /// Second moments of Adam, in the same layout.
        motion_grid_second,
        /// Gradient, in the same layout.
        motion_grid_gradient,
    }
}

impl GridBuffers {
    /// Creates a grid with zero displacements.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn new(gpu: &Gpu, deformable: &MotionGridSetup, n_phases: usize) -> Result<GridBuffers> {
        let since_rest = |phase: usize| (phase as f64 - f64::from(deformable.rest_phase)) / n_phases as f64;
        let basis_at = |phase: usize| basis(deformable.n_basis as usize, since_rest(phase));
        let basis: Vec<f32> = (0..n_phases).flat_map(basis_at).map(|v| v as f32).collect();
        let at_rest = vec![[0f32; 4]; n_phases * deformable.nodes()];
        let grid = |name: Binding| gpu.buffer_with(name.name(), &at_rest);
        Ok(GridBuffers {
            deformable_setup: gpu.buffer_with("deformable_setup", &[*deformable])?,
            motion_basis: gpu.buffer_with("motion_basis", &basis)?,
            motion_grid: grid(Binding::motion_grid)?,
            motion_grid_first: grid(Binding::motion_grid_first)?,
            motion_grid_second: grid(Binding::motion_grid_second)?,
            motion_grid_gradient: grid(Binding::motion_grid_gradient)?,
        })
    }

    /// Returns the buffers of this grid with other constants.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn under(&self, gpu: &Gpu, deformable: &MotionGridSetup) -> Result<GridBuffers> {
        Ok(GridBuffers { deformable_setup: gpu.buffer_with("deformable_setup", &[*deformable])?, ..self.clone() })
    }
}

/// Own motion with Adam's moments: `[Gaussian][basis function]`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OwnMotion {
    /// Amplitudes.
    pub amplitudes: Vec<[f32; 4]>,
    /// First moments.
    pub first: Vec<[f32; 4]>,
    /// Second moments.
    pub second: Vec<[f32; 4]>,
}

buffer_set! {
    /// Own motion of Gaussians on the device.
    pub struct OwnMotionBuffers {
        /// `[Gaussian][basis function]`: amplitudes.
        own_motion,
        /// First moments of Adam, in the same layout.
        own_motion_first,
        /// Second moments of Adam, in the same layout.
        own_motion_second,
        /// `[phase][Gaussian]`: gradient of the position.
        place_gradient,
    }
}

impl OwnMotion {
    /// Returns motion of these amplitudes with zero moments.
    pub fn fresh(amplitudes: Vec<[f32; 4]>) -> OwnMotion {
        let zeros = vec![[0.0; 4]; amplitudes.len()];
        OwnMotion { amplitudes, first: zeros.clone(), second: zeros }
    }

    /// Keeps the motion of Gaussians marked in `keep`, one mark per Gaussian.
    pub fn retain(&mut self, keep: &[bool]) {
        retain_marked(&mut self.amplitudes, keep);
        retain_marked(&mut self.first, keep);
        retain_marked(&mut self.second, keep);
    }

    /// Appends motion with zero moments.
    pub fn append(&mut self, amplitudes: Vec<[f32; 4]>) {
        let fresh = OwnMotion::fresh(amplitudes);
        self.amplitudes.extend(fresh.amplitudes);
        self.first.extend(fresh.first);
        self.second.extend(fresh.second);
    }

    /// Uploads the motion to the device, with room for `n_places` positions: one per Gaussian and phase.
    ///
    /// # Errors
    /// [`crate::error::Error::OutOfMemory`] naming the buffer.
    pub fn upload(&self, gpu: &Gpu, n_places: u64) -> Result<OwnMotionBuffers> {
        Ok(OwnMotionBuffers {
            own_motion: gpu.buffer_with("own_motion", &self.amplitudes)?,
            own_motion_first: gpu.buffer_with("own_motion_first", &self.first)?,
            own_motion_second: gpu.buffer_with("own_motion_second", &self.second)?,
            place_gradient: gpu.buffer("place_gradient", 16 * n_places, Memory::Device)?,
        })
    }
}

impl OwnMotionBuffers {
    /// Reads the first `n` vectors back.
    ///
    /// # Errors
    /// Device errors.
    pub fn download(&self, gpu: &Gpu, n: usize) -> Result<OwnMotion> {
        Ok(OwnMotion {
            amplitudes: gpu.download(&self.own_motion, 0, n)?,
            first: gpu.download(&self.own_motion_first, 0, n)?,
            second: gpu.download(&self.own_motion_second, 0, n)?,
        })
    }
}

/// A recording of stages on a deformable set.
pub struct DeformablePass<'a> {
    /// The deformable set's Gaussians at rest, and their target data.
    pub gaussians: GaussianPass<'a>,
    /// The deformable set's own stages.
    pub kernels: &'a DeformableKernels,
    /// The grid.
    pub grid: &'a GridBuffers,
    /// Own motion.
    pub own: &'a OwnMotionBuffers,
    /// Filling; none where vessels are full all the time.
    pub filling: Option<&'a FillingBuffers>,
    /// Constants on the host.
    pub setup: &'a MotionGridSetup,
}

impl DeformablePass<'_> {
    fn run<P: PushConstants>(&mut self, stage: &Stage<P>, groups: Groups<'_>, push: P) -> Result<()> {
        let mut more: Vec<&dyn BufferSet> = vec![self.grid, self.own];
        more.extend(self.filling.map(|filling| filling as &dyn BufferSet));
        self.gaussians.run(stage, groups, &more, push)
    }

    /// Returns the workgroups of a stage on the nodes of some phases.
    fn nodes<P: PushConstants>(&self, stage: &Stage<P>, n_phases: usize) -> Groups<'static> {
        Groups::Direct([(self.setup.nodes() as u32).div_ceil(stage.local_size()), n_phases as u32, 1])
    }

    /// Returns the number of splats of some phases.
    fn n_splats(&self, phases: &Range<u32>) -> u32 {
        self.gaussians.n * phases.len() as u32 * self.gaussians.setup.n_views
    }

    /// Records the gradient at some phases, whose images are `images`.
    fn gradient(&mut self, phases: Range<u32>, images: Range<u32>) -> Result<()> {
        record_images(self, phases.clone())?;
        let n_splats = self.n_splats(&phases);
        self.gaussians.residual(images, n_splats)?;
        self.gradient_of_moments(phases)
    }

    /// Records the gradient at some phases from the moments of their splats.
    fn gradient_of_moments(&mut self, phases: Range<u32>) -> Result<()> {
        let n_gaussians = self.gaussians.n;
        let DeformableKernels { gradient, grid_gradient, .. } = self.kernels;
        let (first_phase, n_phases) = (phases.start, phases.len() as u32);
        let push = push::DeformableGradient { n_gaussians, first_phase, n_phases };
        self.run(gradient, gradient.groups_for(n_gaussians), push)?;
        let push = push::DeformableGridGradient { n_gaussians, first_phase, n_phases };
        let groups = phases.len().div_ceil(constants::deformable_grid_gradient::PHASES as usize);
        self.run(grid_gradient, self.nodes(grid_gradient, groups), push)
    }

    /// Records the projection of all Gaussians into every view at some phases, and their filling.
    fn project(&mut self, phases: &Range<u32>) -> Result<()> {
        let (project, n_gaussians) = (&self.kernels.project, self.gaussians.n);
        let n_seen = phases.len() as u32 * self.gaussians.setup.n_views;
        let groups = Groups::Direct([n_gaussians.div_ceil(project.local_size()), n_seen, 1]);
        self.run(project, groups, push::DeformableProject { n_gaussians, first_phase: phases.start })?;
        self.fill(phases)
    }

    /// Records the optimiser and the end of an iteration over all phases.
    fn update(&mut self) -> Result<()> {
        let (update, n_gaussians) = (&self.kernels.update, self.gaussians.n);
        self.run(update, update.groups_for(n_gaussians), push::DeformableUpdate { n_gaussians })?;
        self.grid_update(0..self.gaussians.setup.n_phases)?;
        self.update_filling()?;
        self.gaussians.report()
    }

    /// Records the filling of the splats of some phases, where contrast comes or goes.
    fn fill(&mut self, phases: &Range<u32>) -> Result<()> {
        if self.filling.is_none() {
            return Ok(());
        }
        let (fill, n_gaussians) = (&self.kernels.fill, self.gaussians.n);
        let n_seen = phases.len() as u32 * self.gaussians.setup.n_views;
        let groups = Groups::Direct([n_gaussians.div_ceil(fill.local_size()), n_seen, 1]);
        self.run(fill, groups, push::DeformableFill { n_gaussians, first_phase: phases.start })
    }

    /// Records the update of the filling from the moments of all splats, where contrast comes or goes.
    fn update_filling(&mut self) -> Result<()> {
        if self.filling.is_none() {
            return Ok(());
        }
        let (filling, n_gaussians) = (&self.kernels.filling, self.gaussians.n);
        let (rest_phase, rate, min_filling) = (self.setup.rest_phase, FILLING_RATE, MIN_FILLING);
        let push = push::DeformableFilling { n_gaussians, rest_phase, rate, min_filling };
        self.run(filling, filling.groups_for(n_gaussians), push)
    }

    fn grid_update(&mut self, phases: Range<u32>) -> Result<()> {
        let update = &self.kernels.grid_update;
        let push = push::DeformableGridUpdate { first_phase: phases.start };
        self.run(update, self.nodes(update, phases.len()), push)
    }
}

/// Records the images of some phases; the images must be zero.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_images(pass: &mut DeformablePass<'_>, phases: Range<u32>) -> Result<()> {
    pass.project(&phases)?;
    pass.gaussians.splats(pass.n_splats(&phases))
}

/// Records one iteration over all phases.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_step(pass: &mut DeformablePass<'_>) -> Result<()> {
    let setup = pass.gaussians.setup;
    pass.gradient(0..setup.n_phases, 0..setup.n_images)?;
    pass.update()
}

/// Images of some phases, where those of all phases are more than one buffer holds.
pub struct PhasePart<'a> {
    /// The phases.
    pub phases: Range<u32>,
    /// Number of their images.
    pub n_images: u32,
    /// Number of partial sums of their loss.
    pub n_loss_parts: u32,
    /// Their buffers, in which images are counted from the first one of the part on.
    pub targets: &'a TargetBuffers,
}

/// Records one iteration over all phases, whose images are divided into `parts`: the moments of all splats are collected part by part. The
/// moments in `scratch` hold those of one part. The result is that of [`record_step`], but for the order of the sum of the loss.
///
/// # Errors
/// Errors of [`record_step`].
pub fn record_step_in_parts<'a>(
    pass: &mut DeformablePass<'a>,
    parts: &[PhasePart<'a>],
    scratch: &'a ParticleBuffers,
) -> Result<()> {
    let (whole, particles) = (pass.gaussians.targets, pass.gaussians.particles);
    let (mut moments_done, mut losses_done) = (0, 0);
    for part in parts.iter().filter(|part| part.n_images > 0) {
        let n_splats = pass.n_splats(&part.phases);
        (pass.gaussians.targets, pass.gaussians.particles) = (part.targets, scratch);
        record_images(pass, part.phases.clone())?;
        pass.gaussians.residual(0..part.n_images, n_splats)?;
        let recording = &mut pass.gaussians.recording;
        let moments = MOMENTS_BYTES * u64::from(n_splats);
        recording.copy(&scratch.splat_moments, 0, &particles.splat_moments, moments_done, moments)?;
        let losses = size_of::<f32>() as u64 * u64::from(part.n_loss_parts);
        recording.copy(&part.targets.gaussian_loss_parts, 0, &whole.gaussian_loss_parts, losses_done, losses)?;
        (moments_done, losses_done) = (moments_done + moments, losses_done + losses);
    }
    (pass.gaussians.targets, pass.gaussians.particles) = (whole, particles);
    let all = 0..pass.gaussians.setup.n_phases;
    // Splats are those of the last part now.
    pass.project(&all)?;
    pass.gradient_of_moments(all)?;
    pass.update()
}

/// A phase to be tracked, and the two preceding phases, from which its grid is extrapolated.
#[derive(Debug, Clone)]
pub struct Track {
    /// The phase.
    pub phase: u32,
    /// Preceding phase in the order of tracking.
    pub before: u32,
    /// Phase that precedes `before` in the order of tracking.
    pub before_that: u32,
    /// Images of the phase, which are consecutive.
    pub images: Range<u32>,
    /// Phases whose motion is known before, where contrast comes or goes.
    pub known: Vec<usize>,
}

/// Records the initial guess of a phase's grid, extrapolated from the two preceding phases; the pass has the constants of
/// tracking.
///
/// # Errors
/// [`crate::error::Error::Internal`] when a stage and its buffers do not fit.
pub fn record_guess(pass: &mut DeformablePass<'_>, track: &Track) -> Result<()> {
    let Track { phase, before, before_that, .. } = *track;
    let guess = &pass.kernels.guess;
    let groups = guess.groups_for(pass.setup.nodes() as u32);
    pass.run(guess, groups, push::DeformableGuess { phase, before, before_that })?;
    pass.gaussians.recording.fill(&pass.gaussians.targets.gaussian_step, 0);
    Ok(())
}

/// Records iterations that track a phase on its images, after the initial guess.
///
/// # Errors
/// Errors of [`record_guess`].
pub fn record_track(pass: &mut DeformablePass<'_>, track: &Track, iterations: u32) -> Result<()> {
    let phase = track.phase;
    for _ in 0..iterations {
        pass.gradient(phase..phase + 1, track.images.clone())?;
        pass.grid_update(phase..phase + 1)?;
        pass.gaussians.report()?;
    }
    Ok(())
}
