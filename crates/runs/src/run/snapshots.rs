//! Saving and validation of snapshots of a run, beside training or between its iterations.

use crate::error::{Error, Result};
use crate::gpu::device::Gpu;
use crate::kernels::tuning::Tuning;
use crate::render::renderer::Renderer;
use crate::run::events::Event;
use crate::scan::dataset::{Dataset, Frame};
use crate::score::distance::Distance;
use crate::score::eval::{Scoring, evaluate};
use crate::train::snapshot::Snapshot;
use std::path::Path;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender};
use std::time::Instant;

/// Answer of the worker: an event of a job, or the end of the job.
pub(super) type Answer = Result<Option<Event>>;

/// A snapshot and its tasks.
pub(super) struct Job {
    pub(super) snapshot: Snapshot,
    pub(super) save: bool,
    pub(super) validate: bool,
    /// Seconds of training until then; `None` where training continues meanwhile and wall time counts.
    pub(super) train_s: Option<f64>,
}

/// Worker that saves and validates snapshots.
pub(super) struct SnapshotWorker<'a> {
    pub(super) gpu: &'a Gpu,
    pub(super) tuning: &'a Tuning,
    pub(super) run: &'a Path,
    pub(super) dataset: &'a Dataset,
    pub(super) validation: Vec<&'a Frame>,
    pub(super) distance: Option<Distance>,
    pub(super) begin: Instant,
    /// Iterations after which a network is the dynamic field; none where it is none.
    pub(super) network_begins: Option<u32>,
    /// Ends the current validation once it is true.
    pub(super) cancel: &'a AtomicBool,
}

impl SnapshotWorker<'_> {
    pub(super) fn work(&self, jobs: &Receiver<Job>, done: &Sender<Answer>) {
        let mut renderer = None;
        for job in jobs {
            let mut events = Vec::new();
            let outcome = self.handle(job, &mut renderer, &mut events);
            // If the receiver is gone, nobody needs the answer.
            events.into_iter().for_each(|event| drop(done.send(Ok(Some(event)))));
            let failed = outcome.is_err();
            drop(done.send(outcome.map(|()| None)));
            if failed {
                return;
            }
        }
    }

    fn handle(&self, job: Job, renderer: &mut Option<Renderer>, events: &mut Vec<Event>) -> Result<()> {
        let saved = job.snapshot.wait()?;
        let train_s = job.train_s.unwrap_or_else(|| self.begin.elapsed().as_secs_f64());
        let step = saved.model.step;
        if job.save {
            events.push(Event::Saved { step, path: saved.save(self.run)? });
        }
        if job.validate && !self.validation.is_empty() {
            let renderer = match renderer {
                Some(renderer) => renderer,
                none => none.insert(Renderer::new(self.gpu, &saved.model, self.tuning.clone())?),
            };
            renderer.set_model(&saved.model)?;
            let (mut of_dynamic, mut of_both) = (0f32, 0f32);
            let go_on = |scoring: Scoring<'_>| {
                if let Scoring::Scored { rendering, .. } = scoring {
                    of_dynamic = rendering.dynamic_integral.iter().fold(of_dynamic, |a, b| a.max(*b));
                    of_both = rendering.total_integral().iter().fold(of_both, |a, b| a.max(*b));
                }
                if self.cancel.load(Ordering::Relaxed) { Err(Error::Interrupted) } else { Ok(()) }
            };
            let score = match evaluate(renderer, self.dataset, &self.validation, step, None, go_on) {
                // The run is ending: the snapshot is saved but not scored.
                Err(Error::Interrupted) => return Ok(()),
                score => score?,
            };
            let scene = &saved.model.scene;
            let chamfer_mm = match &self.distance {
                Some(distance) => distance.chamfer_mm(renderer, scene, score.threshold.dynamic_per_mm)?,
                None => None,
            };
            events.push(Event::Validation {
                step,
                train_s,
                dice_dynamic: score.dice.dynamic,
                dice_total: score.dice.total,
                psnr: score.psnr,
                ssim: score.ssim,
                dynamic_integral: self
                    .network_begins
                    .filter(|begin| step > *begin && of_both > 0.0)
                    .map(|_| f64::from(of_dynamic / of_both)),
                chamfer_mm,
            });
        }
        Ok(())
    }
}
