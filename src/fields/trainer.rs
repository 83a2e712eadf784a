//! Owns the buffers and the step count of the fields that rays are marched through; hands iterations to the device, two submits in
//! flight on a GPU, and reads losses without stalling it.

use crate::error::{Error, Result};
use crate::fields::data::FieldData;
use crate::fields::images::TrainingImages;
use crate::fields::setup::sample_capacity;
use crate::fields::state::{FieldsState, LossScale, PendingFields, REPORT_BYTES};
use crate::fields::step::{TrainingBuffers, clear, forward_buffers, record_step};
use crate::fitting::RING_LENGTH;
use crate::fitting::fit::{
    Advance, FieldFeed, Fit, FitData, FitField, FitProgress, FitStart, Iterates, Measured, PendingFit, Start, Use,
};
use crate::fitting::ledger::{Ledger, StageWork, add};
use crate::fitting::losses::{NetworkLosses, SMALLER_STEPS, SMALLER_STEPS_WITH_A_NETWORK, StepLoss};
use crate::fitting::ring::tells_nothing;
use crate::gpu::buffer::{Buffer, Memory};
use crate::gpu::device::Gpu;
use crate::gpu::pace::SubmitPace;
use crate::gpu::record::{Commands, PassTime, Recording, Ticket};
use crate::kernels::layout::{DeviceState, Setup, StepReport};
use crate::kernels::stages::Kernels;
use crate::kernels::tuning::{Layers, Tuning};
use crate::model::scene::Scene;
use crate::network::forward::{ForwardBuffers, occupancy_bytes};
use crate::network::pass::Pass;
use crate::network::static_network::StaticNetwork;
use crate::network::{F32_BYTES, Network, Purpose, largest_chunk};
use crate::scan::pixels::Pixels;
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
    data: FieldData,
    kernels: Kernels,
    /// The dynamic field's network; none where there is a static field alone.
    network: Option<Network>,
    /// The static field, where it is a network as well.
    static_network: Option<StaticNetwork>,
    forward: ForwardBuffers,
    training: TrainingBuffers,
    pace: SubmitPace,
    /// When the last submit was done, or the one under way began.
    last_completion: Instant,
    /// Line integrals of the training images, once they are known.
    images: Option<TrainingImages>,
    /// One iteration, once the images are known.
    single: Option<Commands>,
    /// Several iterations in one recording, as many as a submit takes, once that is known.
    several: Option<(Commands, u32)>,
    in_flight: VecDeque<(Ticket, u32)>,
    submitted: u32,
    completed: u32,
    reported: u32,
}

/// Parameters and state that a fit of fields has left.
#[derive(Clone, Copy)]
pub(crate) struct SavedFields<'a> {
    params: &'a [f32],
    state: &'a FieldsState,
}

impl<'a> SavedFields<'a> {
    /// Returns the fields from which a fit begins; none if it begins from scratch.
    pub(crate) fn at(from: Start<'a>) -> Option<SavedFields<'a>> {
        let (field, _) = from.field.filter(|(_, used)| *used != Use::Show)?;
        Some(SavedFields { params: &field.params, state: from.state_as()? })
    }

    /// Returns the number of iterations done.
    pub(crate) fn step(&self) -> u32 {
        self.state.step
    }
}

/// Returns the path that computes the layers of the dynamic field's network; that of f32 without a network.
fn layers_of(network: Option<&Network>) -> Layers {
    network.map_or(Layers::F32, Network::layers)
}

/// Uploads the parameters, moments and counters with which a fit begins, and returns the counters.
fn upload_start(
    gpu: &Gpu,
    data: &FieldData,
    (forward, training): (&ForwardBuffers, &TrainingBuffers),
    network: Option<&Network>,
    saved: Option<SavedFields<'_>>,
) -> Result<DeviceState> {
    let mut now = DeviceState { loss_scale: network.map_or(1.0, Network::first_loss_scale), ..DeviceState::default() };
    let Some(SavedFields { params, state }) = saved else {
        gpu.upload(&forward.params, 0, &data.params.initial(data.settings.seed))?;
        return Ok(now);
    };
    gpu.upload(&forward.params, 0, params)?;
    gpu.upload(&training.moments, 0, &state.moments)?;
    now.step = state.step;
    now.stopped = u32::from(state.stopped);
    // A run whose learning has ended repeats its last report; a checkpoint without that report repeats zeros.
    if state.stopped && state.last_report.len() * 4 == REPORT_BYTES as usize {
        gpu.upload(&training.ring, last_report_at(now.step), &state.last_report)?;
    }
    // Occupancy of another size, from an older version, starts anew.
    if state.occupancy.len() as u64 * 4 == occupancy_bytes(&data.setup) && !state.occupancy.is_empty() {
        gpu.upload(&forward.occupancy, 0, &state.occupancy)?;
    }
    // A run may change from one path to the other; f32 needs no scale.
    if let (Some(saved), Layers::Matrices) = (state.loss_scale, layers_of(network)) {
        let LossScale { scale, good_updates, return_scale } = saved;
        (now.loss_scale, now.good_updates, now.return_scale) = (scale, good_updates, return_scale);
    }
    Ok(now)
}

fn without_images() -> Error {
    Error::Internal("an iteration of the fields was asked for before their images were set".into())
}

impl FieldsFit {
    /// Begins a fit after `done` iterations, with the fields that were `saved`, if any.
    ///
    /// # Errors
    /// [`Error::Config`] when `tuning` asks for what the device lacks; [`Error::OutOfMemory`]; other device errors.
    pub(crate) fn new(
        gpu: &Gpu,
        data: FieldData,
        tuning: Tuning,
        saved: Option<SavedFields<'_>>,
        done: u32,
    ) -> Result<FieldsFit> {
        let mut fit = FieldsFit::awaiting_images(gpu, data, tuning, saved, done)?;
        let integrals = fit.data.images.clone();
        fit.set_images(|frame| Ok(integrals[frame].clone()))?;
        Ok(fit)
    }

    /// Begins a fit like [`FieldsFit::new`] whose images are set later, before the first iteration.
    ///
    /// # Errors
    /// Errors of [`FieldsFit::new`].
    pub(crate) fn awaiting_images(
        gpu: &Gpu,
        mut data: FieldData,
        tuning: Tuning,
        saved: Option<SavedFields<'_>>,
        done: u32,
    ) -> Result<FieldsFit> {
        let dynamic_network = data.params.dynamic_network.as_ref();
        let limit = dynamic_network.map_or(u32::MAX, |map| largest_chunk(gpu, &tuning, map));
        let largest = tuning.chunk_samples.min(limit);
        data.setup.sample_capacity = data.setup.sample_capacity.min(sample_capacity(largest));
        let network =
            dynamic_network.map(|map| Network::new(gpu, &tuning, &data.setup, map, Purpose::Train)).transpose()?;
        let kernels = Kernels::new(gpu, tuning, data.params.line_len() as u32, data.setup.n_static_samples)?;
        let (forward, training) = (forward_buffers(gpu, &kernels.tuning, &data)?, TrainingBuffers::new(gpu, &data)?);
        let static_network = data.params.static_network.as_ref();
        let static_network = static_network
            .map(|map| StaticNetwork::new(gpu, &kernels.tuning, &data.setup, map, &forward, Purpose::Train));
        let static_network = static_network.transpose()?;
        let networks = static_network.iter().map(StaticNetwork::network).chain(&network);
        clear(gpu, networks, &forward, &training)?;
        let mut now = upload_start(gpu, &data, (&forward, &training), network.as_ref(), saved)?;
        // The static field's iterations follow those of Gaussians, which may have begun anew.
        now.step = done.max(data.settings.begin);
        gpu.upload(&forward.state, 0, &[now])?;
        let per_submit = kernels.tuning.iterations_per_submit.unwrap_or(data.settings.train.iterations_per_submit);
        Ok(FieldsFit {
            pace: SubmitPace::new(kernels.tuning.longest_submit_s, 1, per_submit).giving_way_to(gpu.looks()),
            gpu: gpu.clone(),
            data,
            kernels,
            network,
            static_network,
            forward,
            training,
            last_completion: Instant::now(),
            images: None,
            single: None,
            several: None,
            in_flight: VecDeque::new(),
            submitted: done,
            completed: done,
            reported: done,
        })
    }

    /// Returns the data of the fit.
    pub fn data(&self) -> &FieldData {
        &self.data
    }

    /// Returns the choices made for the device.
    pub fn device_tuning(&self) -> &Tuning {
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

    /// Counts iterations that are submitted, done and reported at once.
    pub(crate) fn count(&mut self, iterations: u32) {
        for done in [&mut self.submitted, &mut self.completed, &mut self.reported] {
            *done += iterations;
        }
    }

    /// Sets the line integrals of the training images: `integrals` returns those of a frame.
    ///
    /// # Errors
    /// [`Error::OutOfMemory`] and other device errors; errors of `integrals`.
    pub(crate) fn set_images(&mut self, integrals: impl Fn(usize) -> Result<Pixels>) -> Result<()> {
        let n_frames = self.data.images.len();
        let images = TrainingImages::new(&self.gpu, n_frames, self.data.setup.n_pixels as usize)?;
        for frame in 0..n_frames {
            images.write(&self.gpu, frame, &integrals(frame)?)?;
        }
        self.images = Some(images);
        self.single = Some(self.recorded(1, "training iteration")?);
        self.several = None;
        Ok(())
    }

    /// Records iterations, so many.
    fn recorded(&self, iterations: u32, name: &str) -> Result<Commands> {
        let images = self.images.as_ref().ok_or_else(without_images)?;
        let mut recording = Recording::new(&self.gpu, name)?;
        for _ in 0..iterations {
            record_step(&mut self.pass(&mut recording), images)?;
        }
        Ok(recording.finish()?)
    }

    /// Submits under way at once: one while their duration is being measured.
    fn submits_in_flight(&self) -> usize {
        if self.pace.is_trying() { 1 } else { submits_in_flight(&self.gpu) }
    }

    /// Records as many iterations as a submit takes, once that is known, and again where it takes fewer, or twice as many.
    fn record_several(&mut self) -> Result<()> {
        let (n, recorded) = (self.pace.items(), self.several.as_ref().map_or(1, |(_, n)| *n));
        if !self.pace.is_trying() && n == 1 {
            self.several = None;
        } else if !self.pace.is_trying() && (n < recorded || n >= 2 * recorded) {
            self.several = Some((self.recorded(n, &format!("{n} training iterations"))?, n));
        }
        Ok(())
    }

    fn pass<'a>(&'a self, recording: &'a mut Recording) -> Pass<'a> {
        Pass {
            recording,
            kernels: &self.kernels,
            network: self.network.as_ref(),
            static_network: self.static_network.as_ref(),
            buffers: &self.forward,
            training: Some(&self.training),
            params: &self.data.params,
            setup: &self.data.setup,
        }
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

    /// Copies fields and state after the iterations submitted so far, behind them on the device; returns at once.
    ///
    /// # Errors
    /// Device errors.
    pub(crate) fn pending(&self) -> Result<PendingFields> {
        let mut recording = Recording::new(&self.gpu, "snapshot")?;
        let mut copy = |from: &Buffer, at: u64, bytes: u64| -> Result<Buffer> {
            let staging = self.gpu.buffer(&format!("{} snapshot", from.name()), bytes, Memory::Readback)?;
            if bytes > 0 {
                recording.copy(from, at, &staging, 0, bytes)?;
            }
            Ok(staging)
        };
        let (n, setup) = (self.data.params.len as u64, &self.data.setup);
        let params = copy(&self.forward.params, 0, 4 * n)?;
        let moments = copy(&self.training.moments, 0, 8 * n)?;
        let state = copy(&self.forward.state, 0, size_of::<DeviceState>() as u64)?;
        let report = copy(&self.training.ring, last_report_at(self.submitted), REPORT_BYTES)?;
        let occupancy = copy(&self.forward.occupancy, 0, occupancy_bytes(setup))?;
        let commands = recording.finish()?;
        let ticket = commands.submit()?;
        Ok(PendingFields {
            gpu: self.gpu.clone(),
            ticket,
            _commands: commands,
            step: self.submitted,
            hull: self.data.hull.clone(),
            n_params: self.data.params.len,
            params,
            moments,
            state,
            report,
            occupancy,
            occupancy_words: occupancy_bytes(setup) as usize / 4,
            scaled: layers_of(self.network.as_ref()) == Layers::Matrices,
            advice: if self.network.is_some() { SMALLER_STEPS_WITH_A_NETWORK } else { SMALLER_STEPS },
        })
    }
}

impl Iterates for FieldsFit {
    fn progress(&self) -> FitProgress {
        FitProgress { submitted: self.submitted, ..FitProgress::at(self.completed) }
    }

    fn advance(&mut self, until: u32) -> Result<Advance> {
        self.record_several()?;
        if self.in_flight.is_empty() {
            self.last_completion = Instant::now();
        }
        // Iterations change when the network starts: when those before it are done, the number per submit is tried anew.
        let starts = self.data.settings.dynamic.delay;
        loop {
            let is_starting = self.submitted == starts && self.completed < starts;
            if self.submitted >= until || is_starting || self.in_flight.len() >= self.submits_in_flight() {
                break;
            }
            let stop = if self.submitted < starts { until.min(starts) } else { until };
            let fits = |(_, n): &&(Commands, u32)| !self.pace.is_trying() && stop - self.submitted >= *n;
            let (commands, n) = match self.several.as_ref().filter(fits) {
                Some((commands, n)) => (commands, *n),
                None => (self.single.as_ref().ok_or_else(without_images)?, 1),
            };
            self.in_flight.push_back((commands.submit()?, n));
            self.submitted += n;
        }
        let Some((ticket, n)) = self.in_flight.pop_front() else { return Ok(Advance::default()) };
        self.gpu.wait(ticket)?;
        self.completed += n;
        self.pace.note(n, self.last_completion.elapsed().as_secs_f64());
        self.last_completion = Instant::now();
        if self.completed == starts {
            self.pace.restart();
        }
        Ok(Advance::of(self.read_losses()?))
    }
}

impl Fit for FieldsFit {
    fn outline(&self) -> FitField {
        FitField { hull: self.data.hull.clone(), ..FitField::default() }
    }

    fn feed(&self) -> FieldFeed {
        FieldFeed { params: Some(self.forward.params.clone()), ..FieldFeed::default() }
    }

    fn snapshot(&self) -> Result<PendingFit> {
        let pending = self.pending()?;
        Ok(Box::new(|| pending.wait()))
    }

    fn measured(&mut self) -> Option<&mut dyn Measured> {
        Some(self)
    }
}

impl Measured for FieldsFit {
    fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        const MAX_PASSES: u32 = 4096;
        let mut recording = Recording::timed(&self.gpu, "profiled iteration", MAX_PASSES)?;
        record_step(&mut self.pass(&mut recording), self.images.as_ref().ok_or_else(without_images)?)?;
        let commands = recording.finish()?;
        self.gpu.wait(commands.submit()?)?;
        self.count(1);
        Ok(commands.pass_times()?)
    }

    fn barriers(&self) -> Option<u32> {
        self.single.as_ref().map(Commands::barriers)
    }

    /// Values looked up in the static tensor field stay in caches, so its stages over samples are not included.
    fn ledger(&self, live_samples: u64) -> Ledger {
        let mut ledger = Ledger::new();
        let networks = self.network.iter().chain(self.static_network.iter().map(StaticNetwork::network));
        for (stage, work) in networks.flat_map(|network| network.work(live_samples)) {
            add(&mut ledger, &stage, work);
        }
        // Gradient read, parameter and two moments read and written.
        add(&mut ledger, "adam", StageWork::per_item(self.data.params.len as u64, 0, 7 * F32_BYTES));
        ledger
    }
}

impl FitData for FieldData {
    fn begin(self: Box<Self>, start: &FitStart<'_>, _: &mut Vec<String>) -> Result<Box<dyn Fit>> {
        let saved = SavedFields::at(start.from);
        let done = saved.map_or(0, |saved| saved.step());
        Ok(Box::new(FieldsFit::new(start.gpu, *self, start.tuning.clone(), saved, done)?))
    }

    fn set_scene(&mut self, scene: &Scene) {
        self.setup = Setup {
            n_motion_rays: self.setup.n_motion_rays,
            n_motion_list: self.setup.n_motion_list,
            n_shown_list: self.setup.n_shown_list,
            n_all_rays: self.setup.n_all_rays,
            n_pixels: self.setup.n_pixels,
            image_width: self.setup.image_width,
            ..scene.setup(&self.settings, &self.params, self.hull.as_ref())
        };
        self.scene = scene.clone();
    }
}
