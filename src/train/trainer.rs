//! Owns the buffers and the step count of a run; hands iterations to the device, two submits in flight,
//! and reads losses without stalling it.

use super::checkpoint::Checkpoint;
use super::plan::Plan;
use super::step::{record_step, training_buffers};
use crate::data::dataset::Dataset;
use crate::data::geometry::CArm;
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::record::{Commands, PassTime, Recording, Ticket};
use crate::kernels::{Buffers, Kernels, Tuning};
use crate::model::field::Model;
use crate::model::scene::RING_LENGTH;
use serde::Serialize;
use std::collections::VecDeque;

/// A loss this many times the first one means the run exploded.
const EXPLOSION: f64 = 1e6;
const SUBMITS_IN_FLIGHT: usize = 2;

/// Losses of one iteration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct StepLoss {
    /// Iterations done after it.
    pub step: u32,
    /// Weighted data terms.
    pub data: f64,
    /// Weighted data term of the dynamic field alone.
    pub dynamic: f64,
    /// Total variation, weighted.
    pub tv: f64,
    /// Occlusion, weighted.
    pub occlusion: f64,
    /// Mean squared residual of the total line integral.
    pub squared_error: f64,
    /// Live dynamic samples of the batch.
    pub live_samples: u64,
}

impl StepLoss {
    /// The objective.
    pub fn total(&self) -> f64 {
        self.data + self.tv + self.occlusion
    }
}

/// A training run on a device.
pub struct Trainer {
    gpu: Gpu,
    plan: Plan,
    kernels: Kernels,
    buffers: Buffers,
    several: Commands,
    single: Commands,
    in_flight: VecDeque<(Ticket, u32)>,
    submitted: u32,
    completed: u32,
    reported: u32,
    first_loss: Option<f64>,
    vessel_attenuation: Option<f64>,
    c_arm: CArm,
    image_size: [usize; 2],
    data_fingerprint: String,
}

/// Fingerprint of the training images (FNV-1a over their bits and geometry).
pub fn data_fingerprint(dataset: &Dataset) -> String {
    let mut hash = 0xcbf2_9ce4_8422_2325u64;
    let mut eat = |bits: u32| hash = (hash ^ u64::from(bits)).wrapping_mul(0x0100_0000_01b3);
    for frame in dataset.training() {
        eat(frame.phase);
        let rays = &dataset.views[frame.view].rays;
        for v in rays.anchor.iter().chain(&rays.direction).flat_map(|p| p.to_array()) {
            eat((v as f32).to_bits());
        }
        frame.integrals.iter().for_each(|v| eat(v.to_bits()));
    }
    format!("{hash:016x}")
}

impl Trainer {
    /// Starts a run from scratch.
    ///
    /// # Errors
    /// Device errors, [`Error::OutOfMemory`] first of all.
    pub fn new(gpu: &Gpu, plan: Plan, dataset: &Dataset) -> Result<Trainer> {
        Self::with_tuning(gpu, plan, dataset, Tuning::for_device(gpu.info()))
    }

    /// Starts a run with kernels chosen by the caller instead of for the device.
    ///
    /// # Errors
    /// As [`Trainer::new`].
    pub fn with_tuning(gpu: &Gpu, plan: Plan, dataset: &Dataset, tuning: Tuning) -> Result<Trainer> {
        let params = plan.params.initial(&plan.config);
        Self::start(gpu, plan, dataset, tuning, &params, None)
    }

    /// Continues a run: the result is the same as without interruption.
    ///
    /// # Errors
    /// [`Error::Config`] when the checkpoint belongs to other data; device errors.
    pub fn resume(gpu: &Gpu, plan: Plan, dataset: &Dataset, checkpoint: &Checkpoint) -> Result<Trainer> {
        if checkpoint.data_fingerprint != data_fingerprint(dataset) {
            return Err(Error::config(
                "--resume",
                dataset.path.display(),
                "the checkpoint was trained on other images or geometry",
            ));
        }
        let model = &checkpoint.model;
        let tuning = Tuning::for_device(gpu.info());
        Self::start(gpu, plan, dataset, tuning, &model.params, Some((&checkpoint.moments, model.step)))
    }

    fn start(
        gpu: &Gpu,
        plan: Plan,
        dataset: &Dataset,
        tuning: Tuning,
        params: &[f32],
        state: Option<(&[[f32; 2]], u32)>,
    ) -> Result<Trainer> {
        let kernels = Kernels::new(gpu, tuning)?;
        let buffers = training_buffers(gpu, &kernels.tuning, &plan)?;
        gpu.upload(buffers.get("params")?, 0, params)?;
        let step = state.map_or(0, |(_, step)| step);
        if let Some((moments, step)) = state {
            gpu.upload(buffers.get("moments")?, 0, moments)?;
            gpu.upload(buffers.get("state")?, 0, &[step])?;
        }
        let record = |n: u32| -> Result<Commands> {
            let mut recording = Recording::new(gpu, &format!("{n} training iterations"))?;
            for _ in 0..n {
                record_step(&mut recording, &kernels, &buffers, &plan)?;
            }
            recording.finish()
        };
        let (several, single) = (record(plan.config.train.iterations_per_submit)?, record(1)?);
        Ok(Trainer {
            gpu: gpu.clone(),
            kernels,
            buffers,
            several,
            single,
            in_flight: VecDeque::new(),
            submitted: step,
            completed: step,
            reported: step,
            first_loss: None,
            vessel_attenuation: dataset.vessel_attenuation,
            c_arm: dataset.reference_c_arm(),
            image_size: [dataset.width, dataset.height],
            data_fingerprint: data_fingerprint(dataset),
            plan,
        })
    }

    /// Iterations done.
    pub fn step(&self) -> u32 {
        self.completed
    }

    /// What the run was prepared from.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Choices made for the device.
    pub fn tuning(&self) -> &Tuning {
        &self.kernels.tuning
    }

    /// Buffers, for rendering while training and for tests.
    pub fn buffers(&self) -> &Buffers {
        &self.buffers
    }

    /// Keeps the device busy towards `until` and returns the losses that became known. Returns with work
    /// in flight unless `until` is reached; an empty list means the target was reached before.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite or exploded; device errors.
    pub fn advance(&mut self, until: u32) -> Result<Vec<StepLoss>> {
        while self.submitted < until && self.in_flight.len() < SUBMITS_IN_FLIGHT {
            let several = self.plan.config.train.iterations_per_submit;
            let (commands, n) =
                if until - self.submitted >= several { (&self.several, several) } else { (&self.single, 1) };
            self.in_flight.push_back((commands.submit()?, n));
            self.submitted += n;
        }
        let Some((ticket, n)) = self.in_flight.pop_front() else { return Ok(Vec::new()) };
        self.gpu.wait(ticket)?;
        self.completed += n;
        self.read_losses()
    }

    fn read_losses(&mut self) -> Result<Vec<StepLoss>> {
        let mut ring = vec![[0f32; 8]; RING_LENGTH as usize];
        self.buffers.get("ring")?.read(&mut ring)?;
        let mut losses = Vec::new();
        while self.reported < self.completed {
            let r = ring[(self.reported % RING_LENGTH) as usize].map(f64::from);
            self.reported += 1;
            let loss = StepLoss {
                step: self.reported,
                data: r[0],
                dynamic: r[1],
                tv: r[2],
                occlusion: r[3],
                squared_error: r[4],
                live_samples: r[5] as u64,
            };
            let first = *self.first_loss.get_or_insert(loss.total());
            if !loss.total().is_finite() || loss.total() > EXPLOSION * first.max(1e-12) {
                return Err(Error::Diverged { step: u64::from(loss.step), quantity: "loss", value: loss.total() });
            }
            losses.push(loss);
        }
        Ok(losses)
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// Device errors.
    pub fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        const MAX_PASSES: u32 = 4096;
        let mut recording = Recording::timed(&self.gpu, "profiled iteration", MAX_PASSES)?;
        record_step(&mut recording, &self.kernels, &self.buffers, &self.plan)?;
        let commands = recording.finish()?;
        self.gpu.wait(commands.submit()?)?;
        self.submitted += 1;
        self.completed += 1;
        self.read_losses()?;
        commands.pass_times()
    }

    /// The fields as they are now; waits for work in flight.
    ///
    /// # Errors
    /// [`Error::Diverged`] when a parameter is not finite; device errors.
    pub fn model(&mut self) -> Result<Model> {
        while !self.in_flight.is_empty() {
            self.advance(self.submitted)?;
        }
        let params: Vec<f32> = self.gpu.download(self.buffers.get("params")?, 0, self.plan.params.len)?;
        if let Some(bad) = params.iter().find(|p| !p.is_finite()) {
            return Err(Error::Diverged {
                step: u64::from(self.completed),
                quantity: "parameter",
                value: f64::from(*bad),
            });
        }
        Ok(Model {
            config: self.plan.config.clone(),
            scene: self.plan.scene.clone(),
            layout: self.plan.params.clone(),
            hull: self.plan.hull.clone(),
            params,
            step: self.completed,
            vessel_attenuation: self.vessel_attenuation,
            c_arm: self.c_arm.clone(),
            image_size: self.image_size,
        })
    }

    /// Everything needed to continue.
    ///
    /// # Errors
    /// As [`Trainer::model`].
    pub fn checkpoint(&mut self) -> Result<Checkpoint> {
        let model = self.model()?;
        let moments = self.gpu.download(self.buffers.get("moments")?, 0, self.plan.params.len)?;
        Ok(Checkpoint { model, moments, data_fingerprint: self.data_fingerprint.clone() })
    }
}
