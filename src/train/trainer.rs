//! Owns the buffers and the step count of a run; hands iterations to the device, two submits in flight,
//! and reads losses without stalling it.

use super::checkpoint::{Checkpoint, LossScale};
use super::network::Network;
use super::plan::Plan;
use super::step::{occupancy_bytes, record_step, training_buffers};
use crate::data::dataset::Dataset;
use crate::data::geometry::CArm;
use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::gpu::record::{Commands, PassTime, Recording, Ticket};
use crate::kernels::{Buffers, Kernels, Tuning};
use crate::layout::DeviceState;
use crate::model::field::Model;
use crate::model::scene::{RING_LENGTH, sample_capacity};
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
    /// Factor on gradients in f16; 1 on the f32 path.
    pub loss_scale: f64,
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
    network: Network,
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
    /// [`Error::Config`] when `tuning` asks for what the device lacks; device errors, [`Error::OutOfMemory`] first of
    /// all.
    pub fn new(gpu: &Gpu, plan: Plan, dataset: &Dataset, tuning: Tuning) -> Result<Trainer> {
        let params = plan.params.initial(&plan.config);
        Self::start(gpu, plan, dataset, tuning, &params, None)
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
                "--resume",
                dataset.path.display(),
                "the checkpoint was trained on other images or geometry",
            ));
        }
        let model = &checkpoint.model;
        Self::start(gpu, plan, dataset, tuning, &model.params, Some(checkpoint))
    }

    fn start(
        gpu: &Gpu,
        mut plan: Plan,
        dataset: &Dataset,
        tuning: Tuning,
        params: &[f32],
        saved: Option<&Checkpoint>,
    ) -> Result<Trainer> {
        let network = Network::new(gpu, &tuning, &plan.params, true)?;
        let kernels = Kernels::new(gpu, tuning)?;
        plan.setup.sample_capacity = plan.setup.sample_capacity.min(sample_capacity(kernels.tuning.chunk_samples));
        let buffers = training_buffers(gpu, &kernels.tuning, &network, &plan)?;
        gpu.upload(buffers.get("params")?, 0, params)?;
        let mut now = DeviceState { step: 0, loss_scale: network.first_loss_scale(), overflowed: 0, good_updates: 0 };
        if let Some(saved) = saved {
            gpu.upload(buffers.get("moments")?, 0, &saved.moments)?;
            now.step = saved.model.step;
            // One of another size, as of an older version, starts anew.
            if saved.occupancy.len() as u64 * 4 == occupancy_bytes(&plan.setup) && !saved.occupancy.is_empty() {
                gpu.upload(buffers.get("occupancy")?, 0, &saved.occupancy)?;
            }
            // A run may change from one path to the other; f32 needs no scale.
            if let (Some(LossScale { scale, good_updates }), Network::Fused(_)) = (saved.loss_scale, &network) {
                (now.loss_scale, now.good_updates) = (scale, good_updates);
            }
        }
        gpu.upload(buffers.get("state")?, 0, &[now])?;
        let step = now.step;
        let record = |n: u32| -> Result<Commands> {
            let mut recording = Recording::new(gpu, &format!("{n} training iterations"))?;
            for _ in 0..n {
                record_step(&mut recording, &kernels, &network, &buffers, &plan)?;
            }
            recording.finish()
        };
        let (several, single) = (record(plan.config.train.iterations_per_submit)?, record(1)?);
        Ok(Trainer {
            gpu: gpu.clone(),
            kernels,
            network,
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
                loss_scale: r[7],
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
        record_step(&mut recording, &self.kernels, &self.network, &self.buffers, &self.plan)?;
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
        let state: Vec<DeviceState> = self.gpu.download(self.buffers.get("state")?, 0, 1)?;
        let loss_scale = match self.network {
            Network::Layers(_) => None,
            Network::Fused(_) => Some(LossScale { scale: state[0].loss_scale, good_updates: state[0].good_updates }),
        };
        let occupancy =
            self.gpu.download(self.buffers.get("occupancy")?, 0, occupancy_bytes(&self.plan.setup) as usize / 4)?;
        Ok(Checkpoint { model, moments, occupancy, loss_scale, data_fingerprint: self.data_fingerprint.clone() })
    }
}
