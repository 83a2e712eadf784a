//! A training run: the fit that its method chose, its losses, and snapshots of it.

use crate::config::Config;
use crate::config::method::MethodKind;
use crate::error::{Error, Result};
use crate::fingerprint::Fingerprint;
use crate::fitting::field::Field;
use crate::fitting::fit::{FieldFeed, Fit, FitField, SavedFit};
use crate::fitting::losses::{LargeLoss, LossWatch, SMALLER_STEPS, StepLoss};
use crate::gaussians::field::{self, DynamicGaussians};
use crate::geometry::CArm;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::kernels::tuning::Tuning;
use crate::methods;
use crate::model::Model;
use crate::model::checkpoint::Checkpoint;
use crate::network::ledger::Ledger;
use crate::plan::Plan;
use crate::scan::dataset::Dataset;
use crate::train::fields::FieldsFit;
use crate::train::snapshot::Snapshot;
use std::sync::Arc;

/// The fit of a run.
enum RunFit {
    /// Fields that rays are marched through.
    Fields(Box<FieldsFit>),
    /// Fit of a method of `crate::methods`.
    Own(Box<dyn Fit>),
}

/// A training run on a device.
pub struct Trainer {
    plan: Plan,
    tuning: Tuning,
    fit: RunFit,
    watch: LossWatch,
    large_loss: Option<LargeLoss>,
    vessel_attenuation: Option<f64>,
    c_arm: CArm,
    image_size: [usize; 2],
    data_fingerprint: String,
}

/// Refuses to continue with fields of another shape.
fn check_shape(plan: &Plan, checkpoint: &Checkpoint) -> Result<()> {
    let same_method = checkpoint.fit.is_some() == plan.fit.is_some()
        && (plan.fit.is_some() || checkpoint.model.gaussians.is_some() == plan.targets.is_some());
    if checkpoint.model.param_map == plan.params && same_method {
        return Ok(());
    }
    Err(Error::config(
        "checkpoint",
        checkpoint.model.param_map.len,
        "its parameters do not have the shape that the configuration and the dataset need",
    ))
}

/// Returns the field and state of a fit that was saved; none for fields that rays are marched through.
fn saved_fit(saved: &Checkpoint) -> Option<SavedFit> {
    let field = match (&saved.model.gaussians, &saved.model.field) {
        (_, Some(field)) => FitField::Own(field.clone()),
        (Some(gaussians), None) => FitField::Gaussians(Box::new(gaussians.clone())),
        (None, None) => return None,
    };
    Some(SavedFit { field, state: saved.fit.clone()? })
}

/// Returns the settings of the configuration's method that make its steps smaller, as advice.
fn smaller_steps(config: &Config) -> &'static str {
    match methods::of(config) {
        Some(method) => method.smaller_steps(),
        None if config.method() == MethodKind::Gaussians => field::SMALLER_STEPS,
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
        earlier: Option<&DynamicGaussians>,
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
        Self::start(gpu, plan, dataset, tuning, Some(checkpoint), checkpoint.model.gaussians.as_ref())
    }

    fn start(
        gpu: &Gpu,
        mut plan: Plan,
        dataset: &Dataset,
        tuning: Tuning,
        saved: Option<&Checkpoint>,
        earlier: Option<&DynamicGaussians>,
    ) -> Result<Trainer> {
        let tuning = tuning.for_network(plan.config.method().has_network());
        let data_fingerprint = data_fingerprint(dataset);
        let of_these_data = saved.filter(|saved| saved.data_fingerprint == data_fingerprint);
        let earlier = earlier.filter(|_| of_these_data.is_none());
        let fit = match plan.fit.take() {
            Some(data) => {
                let mut config = plan.config.clone();
                config.train.iterations_per_submit =
                    tuning.iterations_per_submit.unwrap_or(config.train.iterations_per_submit);
                let saved = of_these_data.and_then(saved_fit);
                RunFit::Own(data.begin(gpu, &config, saved.as_ref(), &mut plan.notes)?)
            }
            None => RunFit::Fields(Box::new(FieldsFit::start(
                gpu,
                &mut plan,
                dataset,
                tuning.clone(),
                saved,
                of_these_data,
                earlier,
            )?)),
        };
        Ok(Trainer {
            watch: LossWatch::new(&plan.config, smaller_steps(&plan.config)),
            large_loss: None,
            // A blended picture is no sum of attenuations.
            vessel_attenuation: dataset.vessel_attenuation.filter(|_| !plan.config.method().is_blended()),
            c_arm: dataset.reference_c_arm(),
            image_size: dataset.reference_view().size,
            data_fingerprint,
            plan,
            tuning,
            fit,
        })
    }

    /// Returns the number of iterations done.
    pub fn step(&self) -> u32 {
        match &self.fit {
            RunFit::Fields(fit) => fit.step(),
            RunFit::Own(fit) => fit.step(),
        }
    }

    /// Returns the number of iterations handed to the device.
    pub fn submitted(&self) -> u32 {
        match &self.fit {
            RunFit::Fields(fit) => fit.submitted(),
            RunFit::Own(fit) => fit.step(),
        }
    }

    /// Returns the plan that the run was prepared from.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Returns the choices made for the device.
    pub fn tuning(&self) -> &Tuning {
        match &self.fit {
            RunFit::Fields(fit) => fit.tuning(),
            RunFit::Own(_) => &self.tuning,
        }
    }

    /// Returns the fields that rays are marched through, for tests and measurements.
    ///
    /// # Errors
    /// [`Error::Internal`] for a method that marches no rays through fields.
    pub fn fields(&self) -> Result<&FieldsFit> {
        match &self.fit {
            RunFit::Fields(fit) => Ok(fit),
            RunFit::Own(_) => Err(Error::Internal("the method marches no rays through fields".into())),
        }
    }

    /// Returns the number of barriers of an iteration; none where no rays are marched through fields.
    pub fn barriers(&self) -> Option<u32> {
        self.fields().ok().map(FieldsFit::barriers)
    }

    /// Returns the minimum work of an iteration's stages with `live_samples` live samples; empty where no rays are marched
    /// through fields.
    pub fn work(&self, live_samples: u64) -> Ledger {
        self.fields().map_or_else(|_| Ledger::new(), |fit| fit.work(self.plan.params.len as u64, live_samples))
    }

    /// Keeps the device busy towards `until` and returns the losses that became known. Returns with work
    /// in flight unless `until` is reached; an empty list means the target was reached before, or that the first iteration
    /// is still being prepared.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite, or at which the configuration ends a run; device errors.
    pub fn advance(&mut self, until: u32) -> Result<Vec<StepLoss>> {
        let (losses, ends_gaussians) = match &mut self.fit {
            RunFit::Fields(fit) => {
                let advanced = fit.advance(&self.plan, until)?;
                (advanced.losses, advanced.ends_gaussians)
            }
            RunFit::Own(fit) => (fit.advance(until)?, false),
        };
        losses.iter().try_for_each(|loss| self.watch_loss(loss))?;
        if ends_gaussians {
            // The losses of the static field are different ones.
            self.watch = LossWatch::new(&self.plan.config, SMALLER_STEPS);
        }
        Ok(losses)
    }

    /// Returns the share done of the preparation before the first iteration; none when that has begun.
    pub fn preparation(&self) -> Option<f64> {
        match &self.fit {
            RunFit::Fields(fit) => fit.preparation(),
            RunFit::Own(_) => None,
        }
    }

    /// Returns the numbers of the field, for those who draw it; `None` where its parameters are those of
    /// [`FieldsFit::forward`].
    pub fn feed(&self) -> Option<FieldFeed> {
        match &self.fit {
            RunFit::Fields(fit) => fit.gaussian_feed().map(FieldFeed::Gaussians),
            RunFit::Own(fit) => Some(fit.feed()),
        }
    }

    /// Watches a loss for one that ends the run, and for the first one that is large.
    fn watch_loss(&mut self, loss: &StepLoss) -> Result<()> {
        if let Some(large) = self.watch.see(loss)? {
            self.large_loss = Some(large);
        }
        Ok(())
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
        match &mut self.fit {
            RunFit::Fields(fit) => fit.profile_step(&self.plan),
            RunFit::Own(fit) => fit.profile_step(),
        }
    }

    /// Returns the model without its parameters, which are on the device, for a renderer that follows the run.
    pub fn outline(&self) -> Model {
        let (gaussians, field) = match &self.fit {
            RunFit::Fields(fit) => (fit.gaussians(), None),
            RunFit::Own(fit) => fit.outline().split(),
        };
        self.model_of(gaussians, field)
    }

    fn model_of(&self, gaussians: Option<DynamicGaussians>, field: Option<Arc<dyn Field>>) -> Model {
        Model {
            config: self.plan.config.clone(),
            scene: self.plan.scene.clone(),
            param_map: self.plan.params.clone(),
            // Gaussians need no hull once they are seeded.
            hull: self.plan.hull.clone().filter(|_| gaussians.is_none()),
            gaussians,
            field,
            params: Vec::new(),
            step: self.submitted(),
            vessel_attenuation: self.vessel_attenuation,
            c_arm: self.c_arm.clone(),
            image_size: self.image_size,
        }
    }

    /// Copies the state after the iterations submitted so far, behind them on the device; returns at once, and training
    /// may go on.
    ///
    /// # Errors
    /// Device errors.
    pub fn snapshot(&self) -> Result<Snapshot> {
        let (model, fields, fit) = match &self.fit {
            RunFit::Fields(fit) => (self.outline(), Some(fit.snapshot(&self.plan)?), None),
            RunFit::Own(fit) => {
                let SavedFit { field, state } = fit.state()?;
                let (gaussians, field) = field.split();
                (self.model_of(gaussians, field), None, Some(state))
            }
        };
        Ok(Snapshot { model, fields, fit, data_fingerprint: self.data_fingerprint.clone() })
    }

    /// Returns the fields after the iterations submitted so far; waits for them.
    ///
    /// # Errors
    /// As [`Snapshot::wait`].
    pub fn model(&mut self) -> Result<Model> {
        Ok(self.checkpoint()?.model)
    }

    /// Returns everything needed to continue; waits for the iterations submitted so far.
    ///
    /// # Errors
    /// As [`Snapshot::wait`].
    pub fn checkpoint(&mut self) -> Result<Checkpoint> {
        while self.fields().is_ok_and(FieldsFit::is_under_way) {
            self.advance(self.submitted())?;
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
