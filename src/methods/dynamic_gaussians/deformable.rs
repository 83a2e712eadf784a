//! Fits a deformable set: Gaussians of one phase, carried through the beat by a grid, all of it together. [`start`]
//! prepares it.

pub mod catheter;
mod conversions;
pub mod filling;
mod linked;
mod members;
mod membership;
pub mod stages;
pub mod start;
mod unseen;

use crate::config::sections::Rule;
use crate::error::{Error, Result};
use crate::evidence::series::blur;
use crate::fitting::iterations::{Iterations, pass_times};
use crate::fitting::ring::{losses, ring};
use crate::gaussians::field::{AGAINST_DIVERGENCE, Gaussians, MovingGaussians};
use crate::gaussians::particles::{ParticleBuffers, Particles};
use crate::gaussians::stages::{GaussianKernels, GaussianPass, TargetBuffers};
use crate::gaussians::view::SplatView;
use crate::gaussians::work::{GaussianWork, SplatCost};
use crate::gpu::device::Gpu;
use crate::gpu::record::{PassTime, Recording};
use crate::kernels::layout::{Gaussian, GaussianSetup, GaussianView, MotionGridSetup};
use crate::methods::dynamic_gaussians::deformable::filling::{Filling, FillingBuffers, from_set_of_phase};
use crate::methods::dynamic_gaussians::deformable::members::{MemberBuffers, Members};
use crate::methods::dynamic_gaussians::deformable::stages::{
    DeformableKernels, DeformablePass, GridBuffers, OwnMotion, OwnMotionBuffers, Track,
};
use crate::methods::dynamic_gaussians::deformable::stages::{
    PhasePart, record_guess, record_images, record_step, record_step_in_parts, record_track,
};
use crate::methods::dynamic_gaussians::deformable::unseen::{complete, complete_phase, is_well_seen};
use crate::methods::dynamic_gaussians::per_phase::{MAX_PASSES, check_count};
use crate::methods::dynamic_gaussians::rules::{DeformableRules, Rules};
use crate::methods::dynamic_gaussians::target_buffers::{
    Renewal, TargetPart, divided_targets, n_loss_parts, padded, renew_bounds, take_images,
};
use crate::methods::dynamic_gaussians::targets::Targets;
use crate::methods::dynamic_gaussians::{seeds, setup};
use crate::raster::Image;

/// Reach of the estimate of fillings at a phase before it is tracked, pixels of the settings.
const GUESS_REACH: f64 = 3.0;
/// Reach of the estimate of fillings at a phase that has been tracked, pixels of the settings.
const TRACKED_REACH: f64 = 2.0;

/// Earlier field with which a fit of a deformable set begins.
#[derive(Clone, Copy)]
pub struct Earlier<'a> {
    /// The field. It may have been fitted to other images of the same vessels.
    pub field: &'a MovingGaussians,
    /// Iteration at which the fit begins.
    pub step: u32,
    /// Whether Gaussians are seeded anew and only move as those of the field; otherwise the fit goes on from these.
    pub reseeds: bool,
}

/// A run on a device.
pub struct DeformableTrainer {
    gpu: Gpu,
    targets: Targets,
    config: Rules,
    kernels: (GaussianKernels, DeformableKernels),
    joint: Fit,
    members: MemberBuffers,
    n: u32,
    iterations: Iterations,
    step: u32,
    /// Whether a catheter is looked for at the end.
    finds_catheter: bool,
    /// Sentence on the catheter that was found at the end.
    finding: Option<String>,
}

/// Setup, schedule and buffers of iterations of one kind: the joint fit of everything, or the tracking of a phase.
pub(super) struct Fit {
    setup: GaussianSetup,
    deformable: MotionGridSetup,
    targets: TargetBuffers,
    /// Parts of the images; tracking, which works on a phase at a time, has a single one.
    parts: Vec<TargetPart>,
    grid: GridBuffers,
}

impl Fit {
    /// A fit of everything, with a grid at rest.
    fn joint(gpu: &Gpu, targets: &Targets, config: &Rules) -> Result<Fit> {
        let settings = targets.lengths.gaussians(&config.gaussians);
        let mut setup = setup::gaussian_setup(targets, &settings);
        let deformable = setup::deformable_setup(targets, &targets.deformable(&config.deformable));
        let (buffers, parts) = divided_targets(gpu, targets, &mut setup, &setup::schedule(&settings))?;
        let grid = GridBuffers::new(gpu, &deformable, targets.n_phases)?;
        Ok(Fit { setup, deformable, targets: buffers, parts, grid })
    }

    /// A fit of the same grid to the same images, blurred, a phase at a time.
    fn tracking(&self, gpu: &Gpu, targets: &Targets, settings: &DeformableRules) -> Result<Fit> {
        let setup = setup::track_setup(&self.setup, settings);
        let deformable = MotionGridSetup { grid_rate: settings.track_rate as f32, ..self.deformable };
        let blurred = |values: &[f32]| {
            let images = values.chunks(targets.n_pixels()).flat_map(|image| {
                let image = Image { width: targets.width, height: targets.height, values: image.to_vec() };
                blur(&image, settings.track_blur as f32).values
            });
            padded(&images.collect::<Vec<_>>(), targets.n_pixels(), &setup).into_owned()
        };
        // One phase at a time: the motion beyond it is not known yet.
        let at_phase = |view: &SplatView| SplatView { after_phase: 0.0, ..view.clone() }.to_device();
        let views: Vec<GaussianView> = targets.views.iter().map(at_phase).collect();
        let buffers = TargetBuffers {
            gaussian_setup: gpu.buffer_with("gaussian_setup of tracking", &[setup])?,
            gaussian_views: gpu.buffer_with("gaussian_views of tracking", &views)?,
            bound_low: gpu.buffer_with("bound_low of tracking", &blurred(&targets.low))?,
            bound_high: gpu.buffer_with("bound_high of tracking", &blurred(&targets.high))?,
            gaussian_schedule: gpu.buffer_with("gaussian_schedule of tracking", &setup::track_schedule(settings))?,
            gaussian_step: gpu.buffer_with("gaussian_step of tracking", &[0u32])?,
            gaussian_ring: ring(gpu, "gaussian_ring of tracking")?,
            ..self.targets.clone()
        };
        let parts = vec![TargetPart::all(targets, buffers.clone())];
        Ok(Fit { setup, deformable, targets: buffers, parts, grid: self.grid.under(gpu, &deformable)? })
    }

    /// Returns the buffers of the Gaussians with moments of the splats of a single part of the images, where there are several parts.
    fn scratch(&self, gpu: &Gpu, members: &MemberBuffers, n: u32) -> Result<ParticleBuffers> {
        let splats = |part: &TargetPart| part.phases.len() as u64 * u64::from(self.setup.n_views * n);
        if self.parts.len() == 1 {
            return Ok(members.particles.clone());
        }
        members.particles.with_moments(gpu, self.parts.iter().map(splats).max().unwrap_or(0))
    }

    /// Records one iteration; `scratch` is that of [`Fit::scratch`].
    fn record_step<'a>(&'a self, pass: &mut DeformablePass<'a>, scratch: &'a ParticleBuffers) -> Result<()> {
        if self.parts.len() == 1 {
            return record_step(pass);
        }
        let part = |part: &'a TargetPart| PhasePart {
            phases: part.phases.clone(),
            n_images: part.images.len() as u32,
            n_loss_parts: n_loss_parts(&part.images, &self.setup),
            targets: &part.buffers,
        };
        record_step_in_parts(pass, &self.parts.iter().map(part).collect::<Vec<_>>(), scratch)
    }
}

impl DeformableTrainer {
    /// Starts from given Gaussians at rest.
    ///
    /// # Errors
    /// [`Error::Config`] for impossible settings; device errors.
    pub fn with(gpu: &Gpu, targets: Targets, config: &Rules, particles: &Particles) -> Result<DeformableTrainer> {
        let n = check_count(particles)?;
        let kernels = (GaussianKernels::new(gpu)?, DeformableKernels::new(gpu)?);
        let joint = Fit::joint(gpu, &targets, config)?;
        let own = OwnMotion::fresh(vec![[0.0; 4]; n as usize * joint.deformable.n_basis as usize]);
        let full = || Filling::fresh(vec![1.0; n as usize * targets.n_phases]);
        let filling = targets.contrast_comes_and_goes.then(full);
        let members = Members { particles: particles.clone(), own, filling }.upload(gpu, &joint.setup)?;
        let iterations = record(gpu, &kernels, &joint, &members, n, config.train.iterations_per_submit)?;
        let (gpu, config) = (gpu.clone(), config.clone());
        Ok(DeformableTrainer {
            gpu,
            targets,
            config,
            kernels,
            joint,
            members,
            n,
            iterations,
            step: 0,
            finds_catheter: true,
            finding: None,
        })
    }

    /// Begins with an earlier field.
    ///
    /// # Errors
    /// As [`DeformableTrainer::with`].
    pub fn after(gpu: &Gpu, targets: Targets, config: &Rules, earlier: Earlier<'_>) -> Result<DeformableTrainer> {
        let rest = earlier.field.rest.in_units(targets.units);
        let mut trainer = DeformableTrainer::with(gpu, targets, config, &Particles::fresh(rest.rows.clone()))?;
        let moving = earlier.field.on_grid(rest, trainer.joint.deformable);
        trainer.gpu.upload(&trainer.joint.grid.motion_grid, 0, &moving.grid)?;
        trainer.gpu.upload(&trainer.members.own.own_motion, 0, &moving.own)?;
        if let (Some(buffers), Some(filling)) = (&trainer.members.filling, &moving.filling) {
            trainer.gpu.upload(&buffers.filling, 0, filling)?;
        }
        trainer.step = earlier.step;
        trainer.gpu.upload(&trainer.joint.targets.gaussian_step, 0, &[trainer.step])?;
        if earlier.reseeds {
            trainer.reseed()?;
        }
        Ok(trainer)
    }

    /// Replaces the Gaussians by seeds of the rest phase, each of which moves and is filled as its nearest neighbour among them.
    fn reseed(&mut self) -> Result<()> {
        if self.config.gaussians.background_every > 0 {
            // The seeds need the bounds on the host.
            self.renew_background(Renewal::OneOfSeveral)?;
        }
        let (targets, moving) = (&self.targets, self.deformable()?);
        let settings = targets.lengths.gaussians(&self.config.gaussians);
        let mut rows = seeds::seeds_at(targets, &settings, self.config.seed, targets.rest_phase);
        self.replace_by(rows.clone(), &moving)?;
        let density = seeds::first_density(&self.targets, &self.images()?);
        rows.iter_mut().for_each(|g| g.log_density = density.ln() as f32);
        self.replace_by(rows, &moving)
    }

    /// Replaces all Gaussians by others of the rest phase, each of which moves and is filled as its nearest neighbour in `deformable`, a
    /// set on the grid of this fit.
    fn replace_by(&mut self, rows: Vec<Gaussian>, deformable: &MovingGaussians) -> Result<()> {
        let mut members = Members::none(self.members.filling.is_some());
        members.append(rows, deformable);
        self.replace(&members)
    }

    /// Returns the fit by which the grid is tracked.
    pub(super) fn tracking(&self) -> Result<Fit> {
        self.joint.tracking(&self.gpu, &self.targets, &self.targets.deformable(&self.config.deformable))
    }

    /// Tracks the grid to a phase from those before it, on blurred images, in submits as long as those of the fit. Where contrast comes or
    /// goes, `of_phase` is a set of Gaussians that was fitted to this phase alone.
    pub(super) fn track(&self, tracking: &Fit, track: &Track, of_phase: Option<&[Gaussian]>) -> Result<()> {
        let submit = |record: &dyn Fn(&mut DeformablePass<'_>) -> Result<()>| -> Result<()> {
            let mut recording = Recording::new(&self.gpu, "tracking")?;
            record(&mut pass(&mut recording, &self.kernels, tracking, &self.members, self.n))?;
            Ok(self.gpu.wait(recording.finish()?.submit()?)?)
        };
        submit(&|pass| record_guess(pass, track))?;
        if let Some(of_phase) = of_phase {
            self.estimate_filling(track.phase, of_phase, GUESS_REACH)?;
        }
        let mut left = if track.images.is_empty() { 0 } else { self.config.deformable.track_iterations };
        while left > 0 {
            let n = left.min(self.config.train.iterations_per_submit);
            submit(&|pass| record_track(pass, track, n))?;
            left -= n;
        }
        if let Some(of_phase) = of_phase {
            self.estimate_filling(track.phase, of_phase, TRACKED_REACH)?;
            self.complete_motion(Some(track))?;
        }
        Ok(())
    }

    /// Estimates the filling at a phase from the set of Gaussians of this phase alone; `reach` is that of [`from_set_of_phase`] in pixels
    /// of the settings. At the rest phase vessels are full.
    fn estimate_filling(&self, phase: u32, of_phase: &[Gaussian], reach: f64) -> Result<()> {
        let Some(buffers) = &self.members.filling else { return Ok(()) };
        let deformable = self.deformable()?;
        let Some(mut values) = deformable.filling.clone() else { return Ok(()) };
        let moved = deformable.at(phase.into());
        let reach = reach * self.targets.lengths.factor;
        let estimated = from_set_of_phase(&moved, of_phase, &self.joint.setup, reach);
        let of_phase = values.iter_mut().skip(phase as usize).step_by(self.targets.n_phases);
        of_phase.zip(estimated).for_each(|(value, estimated)| *value = estimated);
        Ok(self.gpu.upload(&buffers.filling, 0, &values)?)
    }

    /// Completes the motion of vessels that contrast does not show: at a phase that was tracked from those before it, or at all phases.
    fn complete_motion(&self, tracked: Option<&Track>) -> Result<()> {
        if !self.targets.left_out.keeps(Rule::UnseenPhases) {
            return Ok(());
        }
        let mut deformable = self.deformable()?;
        match tracked {
            Some(track) if is_well_seen(&deformable, track.phase as usize) => return Ok(()),
            Some(track) => complete_phase(&mut deformable, track.phase as usize, &track.known),
            None => complete(&mut deformable),
        }
        Ok(self.gpu.upload(&self.joint.grid.motion_grid, 0, &deformable.grid)?)
    }

    /// Clears the optimiser's momentum, so that iterations after tracking begin without it.
    pub(super) fn forget_momentum(&self) -> Result<()> {
        let mut recording = Recording::new(&self.gpu, "clear momentum")?;
        recording.fill(&self.joint.grid.motion_grid_first, 0);
        recording.fill(&self.joint.grid.motion_grid_second, 0);
        Ok(self.gpu.wait(recording.finish()?.submit()?)?)
    }

    /// Looks for no catheter at the end: where poses are wrong, vessels move as one.
    pub(super) fn ignore_catheter(&mut self) {
        self.finds_catheter = false;
    }

    /// Iterations done, those of the sets per phase and of tracking not counted.
    pub fn step(&self) -> u32 {
        self.step
    }

    /// Number of Gaussians of the deformable set.
    pub fn count(&self) -> u32 {
        self.n
    }

    /// Targets of the run.
    pub fn targets(&self) -> &Targets {
        &self.targets
    }

    /// Returns the targets when the run is not wanted.
    pub(super) fn into_targets(self) -> Targets {
        self.targets
    }

    /// Constants of the run.
    pub fn setup(&self) -> &GaussianSetup {
        &self.joint.setup
    }

    /// Constants of the grid.
    pub fn deformable_setup(&self) -> &MotionGridSetup {
        &self.joint.deformable
    }

    /// The Gaussians on the device, for rendering while training and for tests.
    pub fn particles(&self) -> &ParticleBuffers {
        &self.members.particles
    }

    /// Target buffers on the device, for tests.
    pub fn target_buffers(&self) -> &TargetBuffers {
        &self.joint.targets
    }

    /// The grid on the device, as [`DeformableTrainer::particles`].
    pub fn grid(&self) -> &GridBuffers {
        &self.joint.grid
    }

    /// Own motion on the device, as [`DeformableTrainer::particles`].
    pub fn own_motion(&self) -> &OwnMotionBuffers {
        &self.members.own
    }

    /// Filling on the device, as [`DeformableTrainer::particles`]; none where vessels are full all the time.
    pub fn filling(&self) -> Option<&FillingBuffers> {
        self.members.filling.as_ref()
    }

    /// Returns the use of the bounds that are renewed now: the host keeps no bounds of large images that it does not need.
    fn renewal(&self) -> Renewal {
        let settings = &self.config.gaussians;
        let renews_again = |step: u32| step > self.step && setup::renews_background(settings, step);
        let needed = |step: u32| renews_again(step) || setup::grows(settings, step);
        let is_large = self.targets.coarse_factor() > 1;
        if is_large && !(self.step..settings.iterations).any(needed) { Renewal::Last } else { Renewal::OneOfSeveral }
    }

    /// Runs a submit's worth of iterations towards `until`, at most to where the number of Gaussians changes; returns the
    /// losses of the iterations done, penalties not included. An empty list means the target was reached before.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite; device errors.
    pub fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        let until = until.min(self.config.gaussians.iterations);
        if self.step >= until {
            return Ok(Vec::new());
        }
        let settings = &self.config.gaussians;
        let (renew, grow) = (setup::renews_background(settings, self.step), setup::grows(settings, self.step));
        let clear = setup::clears(settings, self.step);
        let stop = setup::next_stop(settings, self.step, until);
        if renew {
            self.renew_background(self.renewal())?;
        }
        if grow {
            self.grow()?;
        }
        if clear {
            self.clear()?;
        }
        let first = self.step;
        self.step += self.iterations.run(&self.gpu, first, stop)?;
        if setup::parts_from_strays(&self.config.gaussians, self.step) {
            self.drop_strays()?;
            if self.finds_catheter {
                self.find_catheter()?;
            }
        }
        if self.step == self.config.gaussians.iterations && self.members.filling.is_some() {
            self.complete_motion(None)?;
        }
        losses(&self.gpu, &self.joint.targets.gaussian_ring, first..self.step, AGAINST_DIVERGENCE)
    }

    /// Estimates the static background anew from what the Gaussians leave of the images, and with it the bounds of the fit's targets.
    fn renew_background(&mut self, renewal: Renewal) -> Result<()> {
        let images = self.images()?;
        renew_bounds(&self.gpu, &mut self.targets, &self.joint.parts, &self.joint.setup, &images, renewal)
    }

    /// Keeps some of the Gaussians on the device, and returns them.
    fn retain(&mut self, kept: impl FnOnce(&[Gaussian]) -> Vec<bool>) -> Result<Members> {
        let mut members = self.download()?;
        members.retain(&kept(&members.particles.rows));
        self.replace(&members)?;
        Ok(members)
    }

    /// Reads all Gaussians back.
    fn download(&self) -> Result<Members> {
        let n_basis = self.joint.deformable.n_basis as usize;
        self.members.download(&self.gpu, self.n as usize, n_basis, self.targets.n_phases)
    }

    fn replace(&mut self, members: &Members) -> Result<()> {
        self.n = check_count(&members.particles)?;
        self.members = members.upload(&self.gpu, &self.joint.setup)?;
        let per_submit = self.config.train.iterations_per_submit;
        self.iterations = record(&self.gpu, &self.kernels, &self.joint, &self.members, self.n, per_submit)?;
        Ok(())
    }

    /// Images of the present field, `[image][pixel]`, shares of the strongest change.
    ///
    /// # Errors
    /// Device errors.
    pub fn images(&self) -> Result<Vec<f32>> {
        let mut images = Vec::with_capacity(self.targets.n_images * self.targets.n_pixels());
        for part in &self.joint.parts {
            let mut recording = Recording::new(&self.gpu, "images of a deformable")?;
            let mut pass = pass(&mut recording, &self.kernels, &self.joint, &self.members, self.n);
            pass.gaussians.targets = &part.buffers;
            record_images(&mut pass, part.phases.clone())?;
            self.gpu.wait(recording.finish()?.submit()?)?;
            take_images(&self.gpu, part, &self.targets, &self.joint.setup, &mut images)?;
        }
        Ok(images)
    }

    /// Images of the present field that other `views` see, one for each image of the targets.
    ///
    /// # Errors
    /// Device errors.
    pub(super) fn images_through(&self, views: &[SplatView]) -> Result<Vec<f32>> {
        let upload = |views: &[SplatView]| -> Result<()> {
            let views: Vec<GaussianView> = views.iter().map(SplatView::to_device).collect();
            for part in &self.joint.parts {
                self.gpu.upload(&part.buffers.gaussian_views, 0, &views[part.images.clone()])?;
            }
            Ok(())
        };
        upload(views)?;
        let images = self.images();
        upload(&self.targets.views)?;
        images
    }

    /// The deformable set after the iterations done.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a parameter is not finite; device errors.
    pub fn deformable(&self) -> Result<MovingGaussians> {
        let (n, deformable) = (self.n as usize, self.joint.deformable);
        let grid: Vec<[f32; 4]> =
            self.gpu.download(&self.joint.grid.motion_grid, 0, self.targets.n_phases * deformable.nodes())?;
        let own: Vec<[f32; 4]> = self.gpu.download(&self.members.own.own_motion, 0, n * deformable.n_basis as usize)?;
        if let Some(bad) = grid.iter().chain(&own).flatten().find(|v| !v.is_finite()) {
            let step = u64::from(self.step);
            let (quantity, value) = ("the motion of the deformable set", f64::from(*bad));
            return Err(Error::Diverged { step, quantity, value, advice: AGAINST_DIVERGENCE });
        }
        let rest = Gaussians {
            units: self.targets.units,
            n_phases: self.targets.n_phases,
            setup: self.joint.setup,
            rows: self.gpu.download(&self.members.particles.gaussians, 0, n)?,
            step: self.step,
            is_crowd: false,
            agreement: None,
            intensities: None,
        };
        rest.check()?;
        let read = |buffers: &FillingBuffers| self.gpu.download(&buffers.filling, 0, n * self.targets.n_phases);
        let filling = self.members.filling.as_ref().map(read).transpose()?;
        Ok(MovingGaussians { rest, setup: deformable, grid, own, filling })
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// Device errors.
    pub fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        let mut recording = Recording::timed(&self.gpu, "profiled iteration of a deformable", MAX_PASSES)?;
        let scratch = self.joint.scratch(&self.gpu, &self.members, self.n)?;
        self.joint
            .record_step(&mut pass(&mut recording, &self.kernels, &self.joint, &self.members, self.n), &scratch)?;
        self.step += 1;
        pass_times(&self.gpu, recording)
    }

    /// Work of the last iteration.
    ///
    /// # Errors
    /// Device errors.
    pub fn work(&self) -> Result<GaussianWork> {
        let setup = &self.joint.setup;
        let splats = (&self.members.particles.splats, &self.members.particles.image_of_splat);
        GaussianWork::of(&self.gpu, setup, splats, self.n * setup.n_views * setup.n_phases, SplatCost::AFFINE)
    }
}

fn pass<'a>(
    recording: &'a mut Recording,
    kernels: &'a (GaussianKernels, DeformableKernels),
    fit: &'a Fit,
    members: &'a MemberBuffers,
    n: u32,
) -> DeformablePass<'a> {
    let (common, kernels) = kernels;
    let MemberBuffers { particles, own, filling } = members;
    DeformablePass {
        gaussians: GaussianPass { recording, kernels: common, targets: &fit.targets, particles, setup: &fit.setup, n },
        kernels,
        grid: &fit.grid,
        own,
        filling: filling.as_ref(),
        setup: &fit.deformable,
    }
}

fn record(
    gpu: &Gpu,
    kernels: &(GaussianKernels, DeformableKernels),
    fit: &Fit,
    members: &MemberBuffers,
    n: u32,
    per_submit: u32,
) -> Result<Iterations> {
    let scratch = fit.scratch(gpu, members, n)?;
    Iterations::record(gpu, per_submit, |iterations| {
        let mut recording = Recording::new(gpu, &format!("{iterations} iterations of a deformable"))?;
        let mut pass = pass(&mut recording, kernels, fit, members, n);
        for _ in 0..iterations {
            fit.record_step(&mut pass, &scratch)?;
        }
        Ok(recording.finish()?)
    })
}
