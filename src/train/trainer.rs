//! Owns the buffers and the step count of a run; hands iterations to the device, two submits in flight on a GPU,
//! and reads losses without stalling it.

use crate::config::Config;
use crate::error::{Error, Result};
use crate::fingerprint::Fingerprint;
use crate::fitting::RING_LENGTH;
use crate::fitting::fit::{Fit, SavedFit};
use crate::fitting::losses::{LargeLoss, LossWatch, NetworkLosses, SMALLER_STEPS, StepLoss};
use crate::fitting::ring::tells_nothing;
use crate::geometry::CArm;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::pace::SubmitPace;
use crate::gpu::record::{Commands, PassTime, Recording, Ticket};
use crate::kernels::layout::{DeviceState, StepReport};
use crate::kernels::stages::Kernels;
use crate::kernels::tuning::{Layers, Tuning};
use crate::methods;
use crate::model::Model;
use crate::model::checkpoint::{Checkpoint, LossScale};
use crate::model::gaussians::{self, MovingFeed, MovingGaussians};
use crate::model::setup::sample_capacity;
use crate::model::{r2, x_gaussian};
use crate::network::forward::{ForwardBuffers, occupancy_bytes};
use crate::network::ledger::{Ledger, StageWork, add};
use crate::network::pass::Pass;
use crate::network::still::StillNetwork;
use crate::network::{F32_BYTES, Network, Purpose, largest_chunk};
use crate::plan::Plan;
use crate::scan::dataset::Dataset;
use crate::train::moving::Moving;
use crate::train::snapshot::{REPORT_BYTES, Snapshot};
use crate::train::step::{TrainingBuffers, clear, forward_buffers, record_step};
use std::collections::VecDeque;
use std::time::Instant;

/// Offset in the ring of the report of the last of `step` iterations, bytes.
fn last_report_at(step: u32) -> u64 {
    u64::from(step.saturating_sub(1) % RING_LENGTH) * REPORT_BYTES
}

/// Submits under way at once: two keep a GPU from waiting for the host; on a CPU nothing waits, and views of a run in
/// training come up sooner.
fn submits_in_flight(gpu: &Gpu) -> usize {
    if gpu.info().is_cpu() { 1 } else { 2 }
}

/// A training run on a device.
pub struct Trainer {
    gpu: Gpu,
    plan: Plan,
    kernels: Kernels,
    network: Network,
    /// The static field, where it is a network as well.
    still: Option<StillNetwork>,
    forward: ForwardBuffers,
    training: TrainingBuffers,
    /// Gaussians, where they are the dynamic field.
    moving: Option<Moving>,
    /// Fit of a method of `crate::methods`, which is then the only fit.
    fit: Option<Box<dyn Fit>>,
    pace: SubmitPace,
    /// When the last submit was done, or the one under way began.
    last_completion: Instant,
    /// An iteration of fields that rays are marched through; none where Gaussians are all there is.
    single: Option<Commands>,
    /// Several iterations in one recording, as many as a submit takes, once that is known.
    several: Option<(Commands, u32)>,
    in_flight: VecDeque<(Ticket, u32)>,
    submitted: u32,
    completed: u32,
    reported: u32,
    watch: LossWatch,
    large_loss: Option<LargeLoss>,
    vessel_attenuation: Option<f64>,
    c_arm: CArm,
    image_size: [usize; 2],
    data_fingerprint: String,
}

/// Refuses to continue with fields of another shape.
fn check_shape(plan: &Plan, checkpoint: &Checkpoint) -> Result<()> {
    let has_gaussians = plan.targets.is_some() || plan.r2.is_some() || plan.x.is_some();
    let same_method =
        checkpoint.model.moving.is_some() == has_gaussians && checkpoint.model.field.is_some() == plan.fit.is_some();
    if checkpoint.model.param_map == plan.params && same_method {
        return Ok(());
    }
    Err(Error::config(
        "checkpoint",
        checkpoint.model.param_map.len,
        "its parameters do not have the shape that the configuration and the dataset need",
    ))
}

/// Begins the fit of a method of `crate::methods` to the plan's data, or goes on from what was `saved` of one to the same data;
/// none for other methods.
fn begin_fit(gpu: &Gpu, plan: &mut Plan, saved: Option<&Checkpoint>, per_submit: u32) -> Result<Option<Box<dyn Fit>>> {
    let Some(data) = plan.fit.take() else { return Ok(None) };
    let mut config = plan.config.clone();
    config.train.iterations_per_submit = per_submit;
    let state = |saved: &Checkpoint| Some(SavedFit { field: saved.model.field.clone()?, state: saved.fit.clone()? });
    data.begin(gpu, &config, saved.and_then(state).as_ref()).map(Some)
}

/// Returns the settings of the configuration's method that make its steps smaller, as advice.
fn smaller_steps(config: &Config) -> &'static str {
    match methods::of(config) {
        Some(method) => method.smaller_steps(),
        None if config.is_r2() => r2::SMALLER_STEPS,
        None if config.is_x() => x_gaussian::SMALLER_STEPS,
        None if config.gaussians_move() => gaussians::SMALLER_STEPS,
        None => SMALLER_STEPS,
    }
}

/// Fingerprint of the training images: of their bits and geometry.
pub fn data_fingerprint(dataset: &Dataset) -> String {
    let mut fingerprint = Fingerprint::default();
    let mut eat = |bits: u32| fingerprint.word(bits);
    for frame in dataset.training() {
        eat(frame.phase);
        let rays = &dataset.views[frame.view].rays;
        for v in rays.anchor.iter().chain(&rays.direction).flat_map(|p| p.to_array()) {
            eat((v as f32).to_bits());
        }
        let rest = frame.heart_shift_mm.iter().chain([&frame.after_phase]);
        rest.filter(|s| **s != 0.0).for_each(|s| eat((*s as f32).to_bits()));
        dataset.own(frame.view, &frame.integrals).iter().for_each(|v| eat(v.to_bits()));
    }
    if dataset.sizes().len() > 1 {
        // Rays are numbered on the canvas.
        dataset.canvas().into_iter().for_each(|n| eat(n as u32));
    }
    fingerprint.hex()
}

impl Trainer {
    /// Starts a run from scratch.
    ///
    /// # Errors
    /// [`Error::Config`] when `tuning` asks for what the device lacks; device errors, [`Error::OutOfMemory`] first of
    /// all.
    pub fn new(gpu: &Gpu, plan: Plan, dataset: &Dataset, tuning: Tuning) -> Result<Trainer> {
        Self::start(gpu, plan, dataset, tuning, None, None)
    }

    /// Starts a run from scratch but for its Gaussians, which go on from those that were fitted to `earlier` data as in
    /// [`Trainer::carry_on`].
    ///
    /// # Errors
    /// As [`Trainer::new`].
    pub fn start_over(
        gpu: &Gpu,
        plan: Plan,
        dataset: &Dataset,
        tuning: Tuning,
        earlier: Option<&MovingGaussians>,
    ) -> Result<Trainer> {
        Self::start(gpu, plan, dataset, tuning, None, earlier)
    }

    /// Continues a run: the result is the same as without interruption.
    ///
    /// # Errors
    /// [`Error::Config`] when the checkpoint belongs to other data; device errors.
    pub fn resume(
        gpu: &Gpu,
        plan: Plan,
        dataset: &Dataset,
        tuning: Tuning,
        checkpoint: &Checkpoint,
    ) -> Result<Trainer> {
        if checkpoint.data_fingerprint != data_fingerprint(dataset) {
            return Err(Error::config(
                "dataset",
                dataset.path.display(),
                "the checkpoint was trained on different images or a different geometry",
            ));
        }
        check_shape(&plan, checkpoint)?;
        Self::start(gpu, plan, dataset, tuning, Some(checkpoint), None)
    }

    /// Continues a run on other images than it was begun on, for example when more of them arrived. Gaussians go on from those
    /// so far if these explain every view and phase, and are fitted anew otherwise.
    ///
    /// # Errors
    /// [`Error::Config`] when parameters and plan do not fit; device errors.
    pub fn carry_on(
        gpu: &Gpu,
        plan: Plan,
        dataset: &Dataset,
        tuning: Tuning,
        checkpoint: &Checkpoint,
    ) -> Result<Trainer> {
        check_shape(&plan, checkpoint)?;
        Self::start(gpu, plan, dataset, tuning, Some(checkpoint), checkpoint.model.moving.as_ref())
    }

    fn start(
        gpu: &Gpu,
        mut plan: Plan,
        dataset: &Dataset,
        tuning: Tuning,
        saved: Option<&Checkpoint>,
        earlier: Option<&MovingGaussians>,
    ) -> Result<Trainer> {
        let tuning = tuning.for_network(plan.config.network_moves());
        let largest = tuning.chunk_samples.min(largest_chunk(gpu, &tuning, &plan.params.moving));
        plan.setup.sample_capacity = plan.setup.sample_capacity.min(sample_capacity(largest));
        let network = Network::new(gpu, &tuning, &plan.setup, &plan.params.moving, Purpose::Train)?;
        let kernels = Kernels::new(gpu, tuning, plan.params.line_len() as u32, plan.setup.n_static_samples)?;
        let (forward, training) = (forward_buffers(gpu, &kernels.tuning, &plan)?, TrainingBuffers::new(gpu, &plan)?);
        let still = plan.params.still.as_ref();
        let still =
            still.map(|map| StillNetwork::new(gpu, &kernels.tuning, &plan.setup, map, &forward, Purpose::Train));
        let still = still.transpose()?;
        let networks = still.iter().map(StillNetwork::network).chain([&network]);
        clear(gpu, networks, &forward, &training)?;
        match saved {
            Some(saved) => gpu.upload(&forward.params, 0, &saved.model.params)?,
            None => gpu.upload(&forward.params, 0, &plan.params.initial(&plan.config))?,
        }
        let mut now = DeviceState { loss_scale: network.first_loss_scale(), ..DeviceState::default() };
        if let Some(saved) = saved {
            gpu.upload(&training.moments, 0, &saved.moments)?;
            now.step = saved.model.step;
            now.stopped = u32::from(saved.stopped);
            // A run whose learning has ended repeats its last report; a checkpoint without that report repeats zeros.
            if saved.stopped && saved.last_report.len() * 4 == REPORT_BYTES as usize {
                gpu.upload(&training.ring, last_report_at(now.step), &saved.last_report)?;
            }
            // Occupancy of another size, from an older version, starts anew.
            if saved.occupancy.len() as u64 * 4 == occupancy_bytes(&plan.setup) && !saved.occupancy.is_empty() {
                gpu.upload(&forward.occupancy, 0, &saved.occupancy)?;
            }
            // A run may change from one path to the other; f32 needs no scale.
            if let (Some(saved), Layers::Matrices) = (saved.loss_scale, network.layers()) {
                let LossScale { scale, good_updates, return_scale } = saved;
                (now.loss_scale, now.good_updates, now.return_scale) = (scale, good_updates, return_scale);
            }
        }
        let data_fingerprint = data_fingerprint(dataset);
        let of_these_data = saved.filter(|saved| saved.data_fingerprint == data_fingerprint);
        let per_submit = kernels.tuning.iterations_per_submit.unwrap_or(plan.config.train.iterations_per_submit);
        let earlier = earlier.filter(|_| of_these_data.is_none());
        let moving = Moving::begin(gpu, &mut plan, dataset, of_these_data, earlier, per_submit)?;
        let fit = begin_fit(gpu, &mut plan, of_these_data, per_submit)?;
        let of_fit = moving.as_ref().and_then(Moving::step).or(fit.as_ref().map(|fit| fit.step()));
        let step = of_fit.unwrap_or(now.step);
        // The static field's iterations follow those of Gaussians, which may have begun anew.
        now.step = step.max(plan.config.gaussian_iterations());
        gpu.upload(&forward.state, 0, &[now])?;
        let record_single = || {
            let mut recording = Recording::new(gpu, "training iteration")?;
            record_step(&mut Pass {
                recording: &mut recording,
                kernels: &kernels,
                network: &network,
                still: still.as_ref(),
                buffers: &forward,
                training: Some(&training),
                params: &plan.params,
                setup: &plan.setup,
            })?;
            recording.finish()
        };
        let has_still_field = !plan.config.has_gaussians_alone() && fit.is_none();
        let single = has_still_field.then(record_single).transpose()?;
        let trainer = Trainer {
            pace: SubmitPace::new(kernels.tuning.longest_submit_s, 1, per_submit).giving_way_to(gpu.looks()),
            gpu: gpu.clone(),
            kernels,
            network,
            still,
            forward,
            training,
            last_completion: Instant::now(),
            single,
            several: None,
            in_flight: VecDeque::new(),
            submitted: step,
            completed: step,
            reported: step,
            watch: LossWatch::new(&plan.config, smaller_steps(&plan.config)),
            large_loss: None,
            moving,
            fit,
            // X-Gaussian's opacities are no attenuation.
            vessel_attenuation: dataset.vessel_attenuation.filter(|_| !plan.config.is_x()),
            c_arm: dataset.reference_c_arm(),
            image_size: dataset.reference_view().size,
            data_fingerprint,
            plan,
        };
        // A field that was fitted before has left its images already.
        if trainer.moving.as_ref().is_some_and(|m| !m.is_fitting()) {
            trainer.leave_to_still_field()?;
        }
        Ok(trainer)
    }

    /// Iterations done.
    pub fn step(&self) -> u32 {
        self.completed
    }

    /// Plan that the run was prepared from.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Choices made for the device.
    pub fn tuning(&self) -> &Tuning {
        &self.kernels.tuning
    }

    /// Buffers of the forward pass, for rendering while training and for tests.
    pub fn forward(&self) -> &ForwardBuffers {
        &self.forward
    }

    /// Buffers of training, for tests.
    pub fn training(&self) -> &TrainingBuffers {
        &self.training
    }

    /// Network of the static field, where it is one, for tests.
    pub fn still(&self) -> Option<&StillNetwork> {
        self.still.as_ref()
    }

    /// Barriers of an iteration; none where no rays are marched through fields.
    pub fn barriers(&self) -> Option<u32> {
        self.single.as_ref().map(Commands::barriers)
    }

    /// Minimum work of an iteration's stages with `live_samples` live samples. Values looked up in the static tensor field stay
    /// in caches, so its stages over samples are not included.
    pub fn work(&self, live_samples: u64) -> Ledger {
        let mut ledger = self.network.work(live_samples);
        for (stage, work) in self.still.iter().flat_map(|still| still.network().work(live_samples)) {
            add(&mut ledger, &stage, work);
        }
        // Gradient read, parameter and two moments read and written.
        add(&mut ledger, "adam", StageWork::per_item(self.plan.params.len as u64, 0, 7 * F32_BYTES));
        ledger
    }

    /// Keeps the device busy towards `until` and returns the losses that became known. Returns with work
    /// in flight unless `until` is reached; an empty list means the target was reached before, or that the first iteration
    /// is still being prepared.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite, or at which the configuration ends a run; device errors.
    pub fn advance(&mut self, until: u32) -> Result<Vec<StepLoss>> {
        if self.moving.as_ref().is_some_and(Moving::is_fitting) && self.completed < until {
            return self.advance_gaussians(until);
        }
        if self.fit.is_some() {
            return self.advance_fit(until);
        }
        self.record_several()?;
        if self.in_flight.is_empty() {
            self.last_completion = Instant::now();
        }
        // Iterations change when the network starts: when those before it are done, the number per submit is tried anew.
        let starts = self.plan.config.dynamic.delay;
        while let Some(single) = &self.single {
            let is_starting = self.submitted == starts && self.completed < starts;
            if self.submitted >= until || is_starting || self.in_flight.len() >= self.submits_in_flight() {
                break;
            }
            let stop = if self.submitted < starts { until.min(starts) } else { until };
            let fits = |(_, n): &&(Commands, u32)| !self.pace.is_trying() && stop - self.submitted >= *n;
            let (commands, n) = match self.several.as_ref().filter(fits) {
                Some((commands, n)) => (commands, *n),
                None => (single, 1),
            };
            self.in_flight.push_back((commands.submit()?, n));
            self.submitted += n;
        }
        let Some((ticket, n)) = self.in_flight.pop_front() else { return Ok(Vec::new()) };
        self.gpu.wait(ticket)?;
        self.completed += n;
        self.pace.note(n, self.last_completion.elapsed().as_secs_f64());
        self.last_completion = Instant::now();
        if self.completed == starts {
            self.pace.restart();
        }
        self.read_losses()
    }

    /// Submits under way at once: one while their duration is being measured.
    fn submits_in_flight(&self) -> usize {
        if self.pace.is_trying() { 1 } else { submits_in_flight(&self.gpu) }
    }

    /// Records as many iterations as a submit takes, once that is known, and again where it takes fewer, or twice as many.
    fn record_several(&mut self) -> Result<()> {
        let (n, recorded) = (self.pace.items(), self.several.as_ref().map_or(1, |(_, n)| *n));
        if self.single.is_none() || (!self.pace.is_trying() && n == 1) {
            self.several = None;
        } else if !self.pace.is_trying() && (n < recorded || n >= 2 * recorded) {
            let mut recording = Recording::new(&self.gpu, &format!("{n} training iterations"))?;
            for _ in 0..n {
                record_step(&mut self.pass(&mut recording))?;
            }
            self.several = Some((recording.finish()?, n));
        }
        Ok(())
    }

    fn pass<'a>(&'a self, recording: &'a mut Recording) -> Pass<'a> {
        Pass {
            recording,
            kernels: &self.kernels,
            network: &self.network,
            still: self.still.as_ref(),
            buffers: &self.forward,
            training: Some(&self.training),
            params: &self.plan.params,
            setup: &self.plan.setup,
        }
    }

    /// Share done of the preparation before the first iteration; none when that has begun.
    pub fn preparation(&self) -> Option<f64> {
        self.moving.as_ref().and_then(Moving::preparation)
    }

    /// The dynamic field as it is now, for those who draw it; none where a network is the dynamic field.
    pub fn moving_feed(&self) -> Option<MovingFeed> {
        self.moving.as_ref().map(Moving::feed)
    }

    /// Runs some iterations of the Gaussians' fit; after its last, the static field begins with what they leave of the images.
    fn advance_gaussians(&mut self, until: u32) -> Result<Vec<StepLoss>> {
        let Some(moving) = &mut self.moving else { return Ok(Vec::new()) };
        let losses = moving.advance(until, self.plan.config.gaussian_iterations())?;
        let ends = !moving.is_fitting();
        if ends {
            self.leave_to_still_field()?;
        }
        let first = self.completed;
        self.count(losses.len() as u32);
        let of = |(loss, step)| StepLoss::of_gaussians(step, loss);
        let losses: Vec<StepLoss> = losses.into_iter().zip(first + 1..).map(of).collect();
        losses.iter().try_for_each(|loss| self.watch_loss(loss))?;
        if ends {
            // The losses of the static field are different ones.
            self.watch = LossWatch::new(&self.plan.config, SMALLER_STEPS);
        }
        Ok(losses)
    }

    /// Parameters on the device of the field of a method of `crate::methods`, for those who draw it; none for other methods.
    pub fn fit_params(&self) -> Option<Vec<Buffer>> {
        self.fit.as_ref().map(|fit| fit.params())
    }

    /// Runs some iterations of the fit of a method of `crate::methods`.
    fn advance_fit(&mut self, until: u32) -> Result<Vec<StepLoss>> {
        let Some(fit) = &mut self.fit else { return Ok(Vec::new()) };
        let losses = fit.advance(until)?;
        self.count(losses.len() as u32);
        losses.iter().try_for_each(|loss| self.watch_loss(loss))?;
        Ok(losses)
    }

    /// Watches a loss for one that ends the run, and for the first one that is large.
    fn watch_loss(&mut self, loss: &StepLoss) -> Result<()> {
        if let Some(large) = self.watch.see(loss)? {
            self.large_loss = Some(large);
        }
        Ok(())
    }

    /// Counts iterations that are submitted, done and reported at once.
    fn count(&mut self, iterations: u32) {
        for done in [&mut self.submitted, &mut self.completed, &mut self.reported] {
            *done += iterations;
        }
    }

    /// Lets the static field be trained on the images minus the dynamic field.
    fn leave_to_still_field(&self) -> Result<()> {
        let Some(moving) = &self.moving else { return Ok(()) };
        let remains = moving.what_remains(&self.gpu, &self.plan)?;
        self.gpu.upload(&self.training.images, 0, &remains)
    }

    fn read_losses(&mut self) -> Result<Vec<StepLoss>> {
        let mut ring = vec![StepReport::default(); RING_LENGTH as usize];
        self.training.ring.read(&mut ring)?;
        let mut losses = Vec::new();
        while self.reported < self.completed {
            let report = ring[(self.reported % RING_LENGTH) as usize];
            self.reported += 1;
            if report.step != self.reported {
                return Err(tells_nothing(&self.gpu, self.reported));
            }
            let loss = StepLoss {
                step: self.reported,
                data: report.data.into(),
                dynamic: report.dynamic_data.into(),
                tv: report.tv.into(),
                occlusion: report.occlusion.into(),
                squared_error: report.squared_error.into(),
                live_samples: report.live_samples.into(),
                loss_scale: report.loss_scale.into(),
                networks: self.still.as_ref().map(|_| NetworkLosses::of(&report)),
            };
            self.watch_loss(&loss)?;
            losses.push(loss);
        }
        Ok(losses)
    }

    /// Returns the first loss that was far above the first one of this start, once: for a warning.
    pub fn take_large_loss(&mut self) -> Option<LargeLoss> {
        self.large_loss.take()
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// Device errors.
    pub fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        const MAX_PASSES: u32 = 4096;
        let of_fit = match (&mut self.moving, &mut self.fit) {
            (Some(moving), _) if self.single.is_none() => Some(moving.profile_step()?),
            (_, Some(fit)) => Some(fit.profile_step()?),
            _ => None,
        };
        if let Some(passes) = of_fit {
            self.count(1);
            return Ok(passes);
        }
        let mut recording = Recording::timed(&self.gpu, "profiled iteration", MAX_PASSES)?;
        record_step(&mut self.pass(&mut recording))?;
        let commands = recording.finish()?;
        self.gpu.wait(commands.submit()?)?;
        self.count(1);
        commands.pass_times()
    }

    /// The model without its parameters, which are on the device, for a renderer that follows the run.
    pub fn outline(&self) -> Model {
        Model {
            config: self.plan.config.clone(),
            scene: self.plan.scene.clone(),
            param_map: self.plan.params.clone(),
            // Gaussians need no hull once they are seeded.
            hull: self.plan.hull.clone().filter(|_| self.moving.is_none()),
            moving: self.moving.as_ref().map(Moving::field),
            field: self.fit.as_ref().map(|fit| fit.outline()),
            params: Vec::new(),
            step: self.submitted,
            vessel_attenuation: self.vessel_attenuation,
            c_arm: self.c_arm.clone(),
            image_size: self.image_size,
        }
    }

    /// Iterations handed to the device.
    pub fn submitted(&self) -> u32 {
        self.submitted
    }

    /// Copies the state after the iterations submitted so far, behind them on the device; returns at once, and training
    /// may go on.
    ///
    /// # Errors
    /// Device errors.
    pub fn snapshot(&self) -> Result<Snapshot> {
        let mut recording = Recording::new(&self.gpu, "snapshot")?;
        let mut copy = |from: &Buffer, at: u64, bytes: u64| -> Result<Buffer> {
            let staging = self.gpu.buffer(&format!("{} snapshot", from.name()), bytes, Memory::Readback)?;
            if bytes > 0 {
                recording.copy(from, at, &staging, 0, bytes)?;
            }
            Ok(staging)
        };
        let n = self.plan.params.len as u64;
        let params = copy(&self.forward.params, 0, 4 * n)?;
        let moments = copy(&self.training.moments, 0, 8 * n)?;
        let state = copy(&self.forward.state, 0, size_of::<DeviceState>() as u64)?;
        let report = copy(&self.training.ring, last_report_at(self.submitted), REPORT_BYTES)?;
        let occupancy = copy(&self.forward.occupancy, 0, occupancy_bytes(&self.plan.setup))?;
        let commands = recording.finish()?;
        let ticket = commands.submit()?;
        let (mut model, mut r2, mut x) = (self.outline(), None, None);
        if let Some((state, field)) = self.moving.as_ref().map(Moving::r2_state).transpose()?.flatten() {
            (model.moving, r2) = (Some(field), Some(state));
        }
        if let Some((state, field)) = self.moving.as_ref().map(Moving::x_state).transpose()?.flatten() {
            (model.moving, x) = (Some(field), Some(state));
        }
        let mut fit = None;
        if let Some(SavedFit { field, state }) = self.fit.as_ref().map(|fit| fit.state()).transpose()? {
            (model.field, fit) = (Some(field), Some(state));
        }
        Ok(Snapshot {
            gpu: self.gpu.clone(),
            ticket,
            _commands: commands,
            params,
            moments,
            state,
            report,
            occupancy,
            occupancy_words: occupancy_bytes(&self.plan.setup) as usize / 4,
            scaled: self.network.layers() == Layers::Matrices,
            model,
            r2,
            x,
            fit,
            data_fingerprint: self.data_fingerprint.clone(),
        })
    }

    /// The fields after the iterations submitted so far; waits for them.
    ///
    /// # Errors
    /// As [`Snapshot::wait`].
    pub fn model(&mut self) -> Result<Model> {
        Ok(self.checkpoint()?.model)
    }

    /// Everything needed to continue; waits for the iterations submitted so far.
    ///
    /// # Errors
    /// As [`Snapshot::wait`].
    pub fn checkpoint(&mut self) -> Result<Checkpoint> {
        while !self.in_flight.is_empty() {
            self.advance(self.submitted)?;
        }
        self.snapshot()?.wait()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Geometry;
    use crate::scan::dataset::{Frame, Layout, Split, View};

    fn dataset() -> Dataset {
        let geometry = Geometry::CArm(CArm {
            primary_deg: 30.0,
            secondary_deg: -10.0,
            sid_mm: 1000.0,
            sod_mm: 600.0,
            pixel_mm: [1.0; 2],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        });
        let frame = |phase, split, value: f32| Frame {
            name: format!("p{phase}"),
            view: 0,
            phase,
            split,
            integrals: vec![value, 1.0, 2.0, 3.0],
            mask: None,
            after_phase: 0.0,
            heart_shift_mm: [0.0; 3],
        };
        Dataset {
            path: "test".into(),
            layout: Layout::Native,
            views: vec![View::new(geometry, [2, 2]).unwrap()],
            frames: vec![frame(0, Split::Train, 0.0), frame(1, Split::Validation, 4.0)],
            width: 2,
            height: 2,
            n_phases: 2,
            notes: Vec::new(),
            depth_range: (-1.0, 1.0),
            hidden: Default::default(),
            vessel_attenuation: None,
        }
    }

    #[test]
    fn a_fingerprint_is_of_what_is_trained_on_and_nothing_else() {
        let before = data_fingerprint(&dataset());
        let of = |change: &dyn Fn(&mut Dataset)| {
            let mut changed = dataset();
            change(&mut changed);
            data_fingerprint(&changed)
        };
        assert_eq!(of(&|d| d.path = "elsewhere".into()), before);
        assert_eq!(of(&|d| d.frames[0].name = "renamed".into()), before);
        assert_eq!(of(&|d| d.frames[1].integrals[0] = 9.0), before, "validation images are not trained on");
        assert_ne!(of(&|d| d.frames[0].integrals[0] = -0.0), before, "every bit counts");
        assert_ne!(of(&|d| d.frames[0].integrals.swap(0, 1)), before);
        assert_ne!(of(&|d| d.frames[0].phase = 1), before);
        assert_ne!(of(&|d| d.views[0].rays.anchor[1].x += 1e-3), before);
    }
}
