//! Owns the buffers and the step count of the fields that rays are marched through; hands iterations to the device, two submits in
//! flight on a GPU, and reads losses without stalling it. Gaussians, where they are the dynamic field, are fitted first.

use crate::error::Result;
use crate::fitting::RING_LENGTH;
use crate::fitting::losses::{NetworkLosses, StepLoss};
use crate::fitting::ring::tells_nothing;
use crate::gaussians::field::{DynamicGaussians, GaussianFeed};
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::pace::SubmitPace;
use crate::gpu::record::{Commands, PassTime, Recording, Ticket};
use crate::kernels::layout::{DeviceState, StepReport};
use crate::kernels::stages::Kernels;
use crate::kernels::tuning::{Layers, Tuning};
use crate::model::checkpoint::{Checkpoint, LossScale};
use crate::model::setup::sample_capacity;
use crate::network::forward::{ForwardBuffers, occupancy_bytes};
use crate::network::ledger::{Ledger, StageWork, add};
use crate::network::pass::Pass;
use crate::network::static_network::StaticNetwork;
use crate::network::{F32_BYTES, Network, Purpose, largest_chunk};
use crate::plan::Plan;
use crate::scan::dataset::Dataset;
use crate::train::run_gaussians::RunGaussians;
use crate::train::snapshot::{FieldsSnapshot, REPORT_BYTES};
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

/// Fields that rays are marched through, with their fit.
pub struct FieldsFit {
    gpu: Gpu,
    kernels: Kernels,
    /// The dynamic field's network; none where Gaussians are the dynamic field.
    network: Option<Network>,
    /// The static field, where it is a network as well.
    static_network: Option<StaticNetwork>,
    forward: ForwardBuffers,
    training: TrainingBuffers,
    /// Gaussians, where they are the dynamic field.
    gaussians: Option<RunGaussians>,
    pace: SubmitPace,
    /// When the last submit was done, or the one under way began.
    last_completion: Instant,
    /// One iteration.
    single: Commands,
    /// Several iterations in one recording, as many as a submit takes, once that is known.
    several: Option<(Commands, u32)>,
    in_flight: VecDeque<(Ticket, u32)>,
    submitted: u32,
    completed: u32,
    reported: u32,
}

/// Progress that a submit made.
#[derive(Default)]
pub(super) struct Advanced {
    /// Losses of the iterations that were done.
    pub losses: Vec<StepLoss>,
    /// Whether the Gaussians' fit has ended, so that the losses that follow are those of the static field.
    pub ends_gaussians: bool,
}

/// Returns the path that computes the layers of the dynamic field's network; that of f32 without a network.
fn layers_of(network: Option<&Network>) -> Layers {
    network.map_or(Layers::F32, Network::layers)
}

impl FieldsFit {
    /// Begins a fit, or continues the one that was `saved`. `of_these_data` is what was saved if it was fitted to the same images;
    /// otherwise Gaussians go on from `earlier` ones where they can.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] when `tuning` asks for what the device lacks; [`crate::error::Error::OutOfMemory`]; other device
    /// errors.
    pub(super) fn start(
        gpu: &Gpu,
        plan: &mut Plan,
        dataset: &Dataset,
        tuning: Tuning,
        saved: Option<&Checkpoint>,
        of_these_data: Option<&Checkpoint>,
        earlier: Option<&DynamicGaussians>,
    ) -> Result<FieldsFit> {
        let dynamic_network = plan.params.dynamic_network.clone();
        let limit = dynamic_network.as_ref().map_or(u32::MAX, |map| largest_chunk(gpu, &tuning, map));
        let largest = tuning.chunk_samples.min(limit);
        plan.setup.sample_capacity = plan.setup.sample_capacity.min(sample_capacity(largest));
        let network =
            dynamic_network.map(|map| Network::new(gpu, &tuning, &plan.setup, &map, Purpose::Train)).transpose()?;
        let kernels = Kernels::new(gpu, tuning, plan.params.line_len() as u32, plan.setup.n_static_samples)?;
        let (forward, training) = (forward_buffers(gpu, &kernels.tuning, plan)?, TrainingBuffers::new(gpu, plan)?);
        let static_network = plan.params.static_network.as_ref();
        let static_network = static_network
            .map(|map| StaticNetwork::new(gpu, &kernels.tuning, &plan.setup, map, &forward, Purpose::Train));
        let static_network = static_network.transpose()?;
        let networks = static_network.iter().map(StaticNetwork::network).chain(&network);
        clear(gpu, networks, &forward, &training)?;
        match saved {
            Some(saved) => gpu.upload(&forward.params, 0, &saved.model.params)?,
            None => gpu.upload(&forward.params, 0, &plan.params.initial(&plan.config))?,
        }
        let mut now = DeviceState {
            loss_scale: network.as_ref().map_or(1.0, Network::first_loss_scale),
            ..DeviceState::default()
        };
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
            if let (Some(saved), Layers::Matrices) = (saved.loss_scale, layers_of(network.as_ref())) {
                let LossScale { scale, good_updates, return_scale } = saved;
                (now.loss_scale, now.good_updates, now.return_scale) = (scale, good_updates, return_scale);
            }
        }
        let per_submit = kernels.tuning.iterations_per_submit.unwrap_or(plan.config.train.iterations_per_submit);
        let gaussians = RunGaussians::begin(gpu, plan, dataset, of_these_data, earlier, per_submit)?;
        let step = gaussians.as_ref().and_then(RunGaussians::step).unwrap_or(now.step);
        // The static field's iterations follow those of Gaussians, which may have begun anew.
        now.step = step.max(plan.config.gaussian_iterations());
        gpu.upload(&forward.state, 0, &[now])?;
        let single = {
            let mut recording = Recording::new(gpu, "training iteration")?;
            record_step(&mut Pass {
                recording: &mut recording,
                kernels: &kernels,
                network: network.as_ref(),
                static_network: static_network.as_ref(),
                buffers: &forward,
                training: Some(&training),
                params: &plan.params,
                setup: &plan.setup,
            })?;
            recording.finish()?
        };
        let fit = FieldsFit {
            pace: SubmitPace::new(kernels.tuning.longest_submit_s, 1, per_submit).giving_way_to(gpu.looks()),
            gpu: gpu.clone(),
            kernels,
            network,
            static_network,
            forward,
            training,
            gaussians,
            last_completion: Instant::now(),
            single,
            several: None,
            in_flight: VecDeque::new(),
            submitted: step,
            completed: step,
            reported: step,
        };
        // A field that was fitted before has left its images already.
        if fit.gaussians.as_ref().is_some_and(|m| !m.is_fitting()) {
            fit.leave_to_static_field(plan)?;
        }
        Ok(fit)
    }

    /// Returns the number of iterations done.
    pub(super) fn step(&self) -> u32 {
        self.completed
    }

    /// Returns the number of iterations handed to the device.
    pub(super) fn submitted(&self) -> u32 {
        self.submitted
    }

    /// Tells whether submits are under way.
    pub(super) fn is_under_way(&self) -> bool {
        !self.in_flight.is_empty()
    }

    /// Returns the choices made for the device.
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
    pub fn static_network(&self) -> Option<&StaticNetwork> {
        self.static_network.as_ref()
    }

    /// Returns the number of barriers of an iteration.
    pub fn barriers(&self) -> u32 {
        self.single.barriers()
    }

    /// Returns the minimum work of an iteration's stages with `live_samples` live samples. Values looked up in the static tensor
    /// field stay in caches, so its stages over samples are not included.
    pub fn work(&self, params: u64, live_samples: u64) -> Ledger {
        let mut ledger = Ledger::new();
        let networks = self.network.iter().chain(self.static_network.iter().map(StaticNetwork::network));
        for (stage, work) in networks.flat_map(|network| network.work(live_samples)) {
            add(&mut ledger, &stage, work);
        }
        // Gradient read, parameter and two moments read and written.
        add(&mut ledger, "adam", StageWork::per_item(params, 0, 7 * F32_BYTES));
        ledger
    }

    /// Keeps the device busy towards `until` and returns the losses that became known. Returns with work in flight unless `until`
    /// is reached; no losses mean that the target was reached before, or that the first iteration is still being prepared.
    ///
    /// # Errors
    /// Device errors.
    pub(super) fn advance(&mut self, plan: &Plan, until: u32) -> Result<Advanced> {
        if self.gaussians.as_ref().is_some_and(RunGaussians::is_fitting) && self.completed < until {
            return self.advance_gaussians(plan, until);
        }
        self.record_several(plan)?;
        if self.in_flight.is_empty() {
            self.last_completion = Instant::now();
        }
        // Iterations change when the network starts: when those before it are done, the number per submit is tried anew.
        let starts = plan.config.dynamic.delay;
        loop {
            let is_starting = self.submitted == starts && self.completed < starts;
            if self.submitted >= until || is_starting || self.in_flight.len() >= self.submits_in_flight() {
                break;
            }
            let stop = if self.submitted < starts { until.min(starts) } else { until };
            let fits = |(_, n): &&(Commands, u32)| !self.pace.is_trying() && stop - self.submitted >= *n;
            let (commands, n) = match self.several.as_ref().filter(fits) {
                Some((commands, n)) => (commands, *n),
                None => (&self.single, 1),
            };
            self.in_flight.push_back((commands.submit()?, n));
            self.submitted += n;
        }
        let Some((ticket, n)) = self.in_flight.pop_front() else { return Ok(Advanced::default()) };
        self.gpu.wait(ticket)?;
        self.completed += n;
        self.pace.note(n, self.last_completion.elapsed().as_secs_f64());
        self.last_completion = Instant::now();
        if self.completed == starts {
            self.pace.restart();
        }
        Ok(Advanced { losses: self.read_losses()?, ends_gaussians: false })
    }

    /// Submits under way at once: one while their duration is being measured.
    fn submits_in_flight(&self) -> usize {
        if self.pace.is_trying() { 1 } else { submits_in_flight(&self.gpu) }
    }

    /// Records as many iterations as a submit takes, once that is known, and again where it takes fewer, or twice as many.
    fn record_several(&mut self, plan: &Plan) -> Result<()> {
        let (n, recorded) = (self.pace.items(), self.several.as_ref().map_or(1, |(_, n)| *n));
        if !self.pace.is_trying() && n == 1 {
            self.several = None;
        } else if !self.pace.is_trying() && (n < recorded || n >= 2 * recorded) {
            let mut recording = Recording::new(&self.gpu, &format!("{n} training iterations"))?;
            for _ in 0..n {
                record_step(&mut self.pass(plan, &mut recording))?;
            }
            self.several = Some((recording.finish()?, n));
        }
        Ok(())
    }

    fn pass<'a>(&'a self, plan: &'a Plan, recording: &'a mut Recording) -> Pass<'a> {
        Pass {
            recording,
            kernels: &self.kernels,
            network: self.network.as_ref(),
            static_network: self.static_network.as_ref(),
            buffers: &self.forward,
            training: Some(&self.training),
            params: &plan.params,
            setup: &plan.setup,
        }
    }

    /// Share done of the preparation before the first iteration; none when that has begun.
    pub(super) fn preparation(&self) -> Option<f64> {
        self.gaussians.as_ref().and_then(RunGaussians::preparation)
    }

    /// The dynamic field as it is now, for those who draw it; none where a network is the dynamic field.
    pub(super) fn gaussian_feed(&self) -> Option<GaussianFeed> {
        self.gaussians.as_ref().map(RunGaussians::feed)
    }

    /// Returns the Gaussians as they are drawn now; none where a network is the dynamic field.
    pub(super) fn gaussians(&self) -> Option<DynamicGaussians> {
        self.gaussians.as_ref().map(RunGaussians::field)
    }

    /// Runs some iterations of the Gaussians' fit; after its last, the static field begins with what they leave of the images.
    fn advance_gaussians(&mut self, plan: &Plan, until: u32) -> Result<Advanced> {
        let Some(gaussians) = &mut self.gaussians else { return Ok(Advanced::default()) };
        let losses = gaussians.advance(until, plan.config.gaussian_iterations())?;
        let ends_gaussians = !gaussians.is_fitting();
        if ends_gaussians {
            self.leave_to_static_field(plan)?;
        }
        let first = self.completed;
        self.count(losses.len() as u32);
        let of = |(loss, step)| StepLoss::of_gaussians(step, loss);
        Ok(Advanced { losses: losses.into_iter().zip(first + 1..).map(of).collect(), ends_gaussians })
    }

    /// Counts iterations that are submitted, done and reported at once.
    fn count(&mut self, iterations: u32) {
        for done in [&mut self.submitted, &mut self.completed, &mut self.reported] {
            *done += iterations;
        }
    }

    /// Lets the static field be trained on the images minus the dynamic field.
    fn leave_to_static_field(&self, plan: &Plan) -> Result<()> {
        let Some(gaussians) = &self.gaussians else { return Ok(()) };
        let remains = gaussians.what_remains(&self.gpu, plan)?;
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
                networks: self.static_network.as_ref().map(|_| NetworkLosses::of(&report)),
            };
            losses.push(loss);
        }
        Ok(losses)
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// Device errors.
    pub(super) fn profile_step(&mut self, plan: &Plan) -> Result<Vec<PassTime>> {
        const MAX_PASSES: u32 = 4096;
        let mut recording = Recording::timed(&self.gpu, "profiled iteration", MAX_PASSES)?;
        record_step(&mut self.pass(plan, &mut recording))?;
        let commands = recording.finish()?;
        self.gpu.wait(commands.submit()?)?;
        self.count(1);
        commands.pass_times()
    }

    /// Copies the state after the iterations submitted so far, behind them on the device; returns at once, and training may go on.
    ///
    /// # Errors
    /// Device errors.
    pub(super) fn snapshot(&self, plan: &Plan) -> Result<FieldsSnapshot> {
        let mut recording = Recording::new(&self.gpu, "snapshot")?;
        let mut copy = |from: &Buffer, at: u64, bytes: u64| -> Result<Buffer> {
            let staging = self.gpu.buffer(&format!("{} snapshot", from.name()), bytes, Memory::Readback)?;
            if bytes > 0 {
                recording.copy(from, at, &staging, 0, bytes)?;
            }
            Ok(staging)
        };
        let n = plan.params.len as u64;
        let params = copy(&self.forward.params, 0, 4 * n)?;
        let moments = copy(&self.training.moments, 0, 8 * n)?;
        let state = copy(&self.forward.state, 0, size_of::<DeviceState>() as u64)?;
        let report = copy(&self.training.ring, last_report_at(self.submitted), REPORT_BYTES)?;
        let occupancy = copy(&self.forward.occupancy, 0, occupancy_bytes(&plan.setup))?;
        let commands = recording.finish()?;
        let ticket = commands.submit()?;
        Ok(FieldsSnapshot {
            gpu: self.gpu.clone(),
            ticket,
            _commands: commands,
            params,
            moments,
            state,
            report,
            occupancy,
            occupancy_words: occupancy_bytes(&plan.setup) as usize / 4,
            scaled: layers_of(self.network.as_ref()) == Layers::Matrices,
        })
    }
}
