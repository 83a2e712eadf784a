//! A training run: the fit that its method chose, its losses, and snapshots of it.

use crate::checkpoint::Checkpoint;
use crate::error::{Error, Result};
use crate::fields::trainer::FieldsFit;
use crate::fingerprint::Fingerprint;
use crate::fitting::fit::{Advance, FieldFeed, Fit, FitField, FitStart, Measured, Start, Use};
use crate::fitting::losses::{LargeLoss, LossWatch, StepLoss};
use crate::geometry::CArm;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::kernels::tuning::Tuning;
use crate::methods;
use crate::model::Model;
use crate::plan::Plan;
use crate::scan::dataset::Dataset;
use crate::train::snapshot::Snapshot;
use std::any::Any;

/// A training run on a device.
pub struct Trainer {
    plan: Plan,
    tuning: Tuning,
    fit: Box<dyn Fit>,
    watch: LossWatch,
    large_loss: Option<LargeLoss>,
    /// Findings about the data that were not taken yet.
    findings: Vec<String>,
    vessel_attenuation: Option<f64>,
    c_arm: CArm,
    image_size: [usize; 2],
    data_fingerprint: String,
}

/// Refuses to continue with fields of another shape.
fn check_shape(plan: &Plan, checkpoint: &Checkpoint) -> Result<()> {
    let saved = &checkpoint.model;
    if saved.param_map == plan.params && saved.config.is_alike(&plan.config) {
        return Ok(());
    }
    Err(Error::config(
        "checkpoint",
        saved.param_map.len,
        "its parameters do not have the shape that the configuration and the dataset need",
    ))
}

/// Returns the fingerprint of the training images: of their bits and geometry.
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
        if frame.contrast != 1.0 {
            eat((frame.contrast as f32).to_bits());
        }
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
        Self::begin(gpu, plan, dataset, tuning, Start::default())
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
        Self::begin(gpu, plan, dataset, tuning, Start::of(&checkpoint.saved_fit(), Use::Resume))
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
        let saved = checkpoint.saved_fit();
        let is_same = checkpoint.data_fingerprint == data_fingerprint(dataset);
        let used = if is_same { Use::Resume } else { Use::GoOn };
        Self::begin(gpu, plan, dataset, tuning, Start::of(&saved, used))
    }

    /// Starts a run with results of earlier fits.
    ///
    /// # Errors
    /// Errors of [`Trainer::new`].
    pub fn begin(gpu: &Gpu, mut plan: Plan, dataset: &Dataset, tuning: Tuning, from: Start<'_>) -> Result<Trainer> {
        let tuning = tuning.for_network(plan.config.has_network());
        let mut config = plan.config.clone();
        config.train.iterations_per_submit = tuning.iterations_per_submit.unwrap_or(config.train.iterations_per_submit);
        let data = plan.data.take().ok_or_else(|| Error::Internal("a fit has begun with these data".into()))?;
        let fit = data.begin(&FitStart { gpu, config: &config, tuning: &tuning, from }, &mut plan.notes)?;
        Ok(Trainer {
            watch: LossWatch::new(&plan.config, methods::of(&plan.config).smaller_steps),
            large_loss: None,
            findings: Vec::new(),
            // A blended picture is no sum of attenuations.
            vessel_attenuation: dataset.vessel_attenuation.filter(|_| !plan.config.is_blended()),
            c_arm: dataset.reference_c_arm(),
            image_size: dataset.reference_view().size,
            data_fingerprint: data_fingerprint(dataset),
            plan,
            tuning,
            fit,
        })
    }

    /// Returns the number of iterations done.
    pub fn step(&self) -> u32 {
        self.fit.progress().step
    }

    /// Returns the number of iterations handed to the device.
    pub fn submitted(&self) -> u32 {
        self.fit.progress().submitted
    }

    /// Returns the plan that the run was prepared from, without its data.
    pub fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Returns the choices made for the device.
    pub fn tuning(&self) -> &Tuning {
        &self.tuning
    }

    /// Returns the fit as the type of its method, for tests and measurements.
    ///
    /// # Errors
    /// [`Error::Internal`] for a fit of another method.
    pub fn fit<T: Any>(&self) -> Result<&T> {
        let other = || Error::Internal("the fit is that of another method".into());
        let fit: &dyn Any = &*self.fit;
        fit.downcast_ref().ok_or_else(other)
    }

    /// Returns the fit of fields that rays are marched through, for tests and measurements.
    ///
    /// # Errors
    /// [`Error::Internal`] for a method that has no such fields, or has Gaussians in front of them.
    pub fn fields(&self) -> Result<&FieldsFit> {
        self.fit()
    }

    /// Returns the fit for measurements, where its method has any.
    pub fn measured(&mut self) -> Option<&mut dyn Measured> {
        self.fit.measured()
    }

    /// Keeps the device busy towards `until` and returns the losses that became known. Returns with work
    /// in flight unless `until` is reached; an empty list means the target was reached before, or that the first iteration
    /// is still being prepared.
    ///
    /// # Errors
    /// [`Error::Diverged`] on a loss that is not finite, or at which the configuration ends a run; device errors.
    pub fn advance(&mut self, until: u32) -> Result<Vec<StepLoss>> {
        let Advance { losses, smaller_steps, findings } = self.fit.advance(until)?;
        self.findings.extend(findings);
        losses.iter().try_for_each(|loss| self.watch_loss(loss))?;
        if let Some(smaller_steps) = smaller_steps {
            self.watch = LossWatch::new(&self.plan.config, smaller_steps);
        }
        Ok(losses)
    }

    /// Returns the share done of the preparation before the first iteration; none when that has begun.
    pub fn preparation(&self) -> Option<f64> {
        self.fit.progress().preparation
    }

    /// Tells whether the field of earlier data is shown, until the fit has a better one.
    pub fn shows_earlier(&self) -> bool {
        self.fit.progress().shows_earlier
    }

    /// Returns the numbers of the field, for those who draw it.
    pub fn feed(&self) -> FieldFeed {
        self.fit.feed()
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

    /// Returns findings about the data since the last call, for the user.
    pub fn take_findings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.findings)
    }

    /// Runs one iteration with a timestamp around each pass; none where the method is not measured.
    ///
    /// # Errors
    /// Device errors.
    pub fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        self.fit.measured().map_or(Ok(Vec::new()), |fit| fit.profile_step())
    }

    /// Returns the model without its parameters, which are on the device, for a renderer that follows the run.
    pub fn outline(&self) -> Model {
        self.model_of(self.fit.outline())
    }

    fn model_of(&self, field: FitField) -> Model {
        let FitField { params, hull, gaussians, own } = field;
        Model {
            config: self.plan.config.clone(),
            scene: self.plan.scene.clone(),
            param_map: self.plan.params.clone(),
            hull,
            gaussians,
            field: own,
            params,
            step: self.submitted(),
            vessel_attenuation: self.vessel_attenuation,
            c_arm: self.c_arm.clone(),
            image_size: self.image_size,
        }
    }

    /// Copies the state after the iterations submitted so far, behind them on the device; returns at once where the method can, and
    /// training may go on.
    ///
    /// # Errors
    /// Device errors.
    pub fn snapshot(&self) -> Result<Snapshot> {
        Ok(Snapshot {
            model: self.model_of(FitField::default()),
            fit: self.fit.snapshot()?,
            data_fingerprint: self.data_fingerprint.clone(),
        })
    }

    /// Returns the fields after the iterations submitted so far; waits for them.
    ///
    /// # Errors
    /// Errors of [`Snapshot::wait`].
    pub fn model(&mut self) -> Result<Model> {
        Ok(self.checkpoint()?.model)
    }

    /// Returns everything needed to continue; waits for the iterations submitted so far.
    ///
    /// # Errors
    /// Errors of [`Snapshot::wait`].
    pub fn checkpoint(&mut self) -> Result<Checkpoint> {
        while self.step() < self.submitted() {
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
            integrals: vec![value, 1.0, 2.0, 3.0].into(),
            mask: None,
            after_phase: 0.0,
            heart_shift_mm: [0.0; 3],
            contrast: 1.0,
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
            still: false,
            vessels_alone: false,
            views_adjusted: false,
            prior: None,
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
