//! Gaussians of a run: their fit, and what they leave of the images to the static field.

use crate::config::{Config, GaussianForm};
use crate::error::{Error, Result};
use crate::gaussians::field::{DynamicGaussians, GaussianFeed};
use crate::gaussians::pictures::Pictures;
use crate::gaussians::work::GaussianWork;
use crate::geometry::ViewRays;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::model::checkpoint::Checkpoint;
use crate::plan::Plan;
use crate::plan::targets::Targets;
use crate::scan::dataset::{Dataset, Frame};
use crate::train::carried::Carried;
use crate::train::deformable::DeformableTrainer;
use crate::train::deformable_start::DeformableStart;
use crate::train::gaussians::GaussianTrainer;
use std::sync::{Arc, Mutex, PoisonError};

/// A fit under way.
pub(super) enum GaussianFit {
    /// A set per phase.
    PerPhase(Box<GaussianTrainer>),
    /// One set for the beat, in preparation.
    Start(Box<DeformableStart>),
    /// One set for the beat.
    Deformable(Box<DeformableTrainer>),
}

impl GaussianFit {
    /// Begins a fit of the form that configuration and data ask for.
    ///
    /// # Errors
    /// As [`GaussianTrainer::new`] and [`DeformableStart::new`].
    pub(super) fn new(gpu: &Gpu, targets: Targets, config: &Config) -> Result<GaussianFit> {
        Ok(match targets.form(config.gaussians.form) {
            GaussianForm::Deformable => GaussianFit::Start(Box::new(DeformableStart::new(gpu, targets, config)?)),
            _ => GaussianFit::PerPhase(Box::new(GaussianTrainer::new(gpu, targets, config)?)),
        })
    }

    /// As [`GaussianFit::new`], but goes on from what was fitted to `earlier` data where that is of use.
    ///
    /// # Errors
    /// As [`GaussianFit::new`] and [`Carried::new`].
    fn after(gpu: &Gpu, mut targets: Targets, config: &Config, earlier: &DynamicGaussians) -> Result<GaussianFit> {
        if let (GaussianForm::Deformable, Some(deformable)) =
            (targets.form(config.gaussians.form), earlier.deformable())
        {
            match Carried::new(gpu, targets, config, deformable)? {
                Carried::On(fit) => return Ok(GaussianFit::Deformable(fit)),
                Carried::Anew(same) => targets = *same,
            }
        }
        GaussianFit::new(gpu, targets, config)
    }

    /// Tells whether the field of a fit of `end` iterations is worth more than one that was fitted to fewer frames.
    fn is_presentable(&self, end: u32) -> bool {
        match self {
            GaussianFit::PerPhase(fit) => fit.step() >= end / 2,
            GaussianFit::Start(_) => false,
            GaussianFit::Deformable(_) => true,
        }
    }

    /// Iterations done.
    pub(super) fn step(&self) -> u32 {
        match self {
            GaussianFit::PerPhase(fit) => fit.step(),
            GaussianFit::Start(_) => 0,
            GaussianFit::Deformable(fit) => fit.step(),
        }
    }

    /// Share done of the preparation before the first iteration; none when that has begun.
    pub(super) fn preparation(&self) -> Option<f64> {
        match self {
            GaussianFit::Start(start) => Some(start.share()),
            GaussianFit::PerPhase(_) | GaussianFit::Deformable(_) => None,
        }
    }

    /// Runs some iterations towards `until`; returns their losses, none while a deformable set is in preparation.
    ///
    /// # Errors
    /// As [`GaussianTrainer::advance`] and [`DeformableStart::advance`].
    pub(super) fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        match self {
            GaussianFit::PerPhase(fit) => fit.advance(until),
            GaussianFit::Start(start) => {
                if let Some(deformable) = start.advance()? {
                    *self = GaussianFit::Deformable(Box::new(deformable));
                }
                Ok(Vec::new())
            }
            GaussianFit::Deformable(fit) => fit.advance(until),
        }
    }

    /// The field after the iterations done.
    ///
    /// # Errors
    /// As [`GaussianTrainer::model`].
    pub(super) fn field(&self) -> Result<DynamicGaussians> {
        Ok(match self {
            GaussianFit::PerPhase(fit) => DynamicGaussians::PerPhase(fit.model()?),
            GaussianFit::Start(start) => DynamicGaussians::PerPhase(start.field()?),
            GaussianFit::Deformable(fit) => DynamicGaussians::Deformable(fit.deformable()?),
        })
    }

    /// Number of Gaussians.
    pub(super) fn count(&self) -> u32 {
        match self {
            GaussianFit::PerPhase(fit) => fit.count(),
            GaussianFit::Start(start) => start.count(),
            GaussianFit::Deformable(fit) => fit.count(),
        }
    }

    /// Form of the field that it fits.
    pub(super) fn form(&self) -> GaussianForm {
        match self {
            GaussianFit::PerPhase(_) => GaussianForm::Phase,
            GaussianFit::Start(_) | GaussianFit::Deformable(_) => GaussianForm::Deformable,
        }
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// Device errors.
    pub(super) fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        match self {
            GaussianFit::PerPhase(fit) => fit.profile_step(),
            GaussianFit::Start(_) => Err(not_begun()),
            GaussianFit::Deformable(fit) => fit.profile_step(),
        }
    }

    /// Work of the last iteration.
    ///
    /// # Errors
    /// Device errors.
    pub(super) fn work(&self) -> Result<GaussianWork> {
        match self {
            GaussianFit::PerPhase(fit) => fit.work(),
            GaussianFit::Start(_) => Err(not_begun()),
            GaussianFit::Deformable(fit) => fit.work(),
        }
    }
}

fn not_begun() -> Error {
    Error::Internal("the iterations of the deformable set have not begun".into())
}

/// The dynamic field of a run, where it is made of Gaussians.
pub(super) struct RunGaussians {
    /// Fit, until its iterations are done; the static field begins then.
    fit: Option<GaussianFit>,
    feed: GaussianFeed,
    /// Whether the field of earlier data is shown, until the fit has a better one.
    shows_earlier: bool,
    /// View of each training image, and its time, counted in phases.
    shots: Vec<(ViewRays, f64)>,
}

impl RunGaussians {
    /// Begins a fit to the plan's targets, or takes over what was `saved` of one to the same targets; none where a network is
    /// the dynamic field. A fit that was saved half way is repeated up to there: that takes seconds and gives the same bits,
    /// however many iterations go into a submit (except for one that had gone on from an earlier deformable set, which begins from
    /// seeds). A field that was fitted to `earlier` data is shown, and gone on from, where it can be.
    ///
    /// # Errors
    /// As [`GaussianFit::new`], and as [`DeformableStart::advance`] for what is done again.
    pub(super) fn begin(
        gpu: &Gpu,
        plan: &mut Plan,
        dataset: &Dataset,
        saved: Option<&Checkpoint>,
        earlier: Option<&DynamicGaussians>,
        per_submit: u32,
    ) -> Result<Option<RunGaussians>> {
        let mut config = plan.config.clone();
        config.train.iterations_per_submit = per_submit;
        let Some(targets) = plan.targets.take() else { return Ok(None) };
        let shot = |frame: &Frame| (dataset.heart_rays(frame), frame.beat_time().phases(dataset.n_phases));
        let saved = saved.map(|saved| &saved.model);
        let (done, end) = (saved.map_or(0, |model| model.step), config.gaussian_iterations());
        let (fit, field) = match saved.and_then(|model| model.gaussians.as_ref()).filter(|_| done >= end) {
            Some(field) => (None, field.clone()),
            None => {
                let mut fit = match earlier {
                    Some(earlier) => GaussianFit::after(gpu, targets, &config, earlier)?,
                    None => GaussianFit::new(gpu, targets, &config)?,
                };
                while fit.step() < done {
                    fit.advance(done)?;
                }
                let field = fit.field()?;
                (Some(fit), field)
            }
        };
        let shown = earlier.filter(|_| fit.as_ref().is_some_and(|fit| !fit.is_presentable(end)));
        let shows_earlier = shown.is_some();
        let feed = Arc::new(Mutex::new((0, shown.cloned().unwrap_or(field))));
        let shots = dataset.training().iter().map(shot).collect();
        Ok(Some(RunGaussians { fit, feed, shows_earlier, shots }))
    }

    /// Iterations done of a fit that is not finished.
    pub(super) fn step(&self) -> Option<u32> {
        self.fit.as_ref().map(GaussianFit::step)
    }

    /// Share done of the preparation before the first iteration; none when that has begun.
    pub(super) fn preparation(&self) -> Option<f64> {
        self.fit.as_ref().and_then(GaussianFit::preparation)
    }

    /// Tells whether iterations of the fit are left.
    pub(super) fn is_fitting(&self) -> bool {
        self.fit.is_some()
    }

    /// Feed for those who draw the field.
    pub(super) fn feed(&self) -> GaussianFeed {
        self.feed.clone()
    }

    /// The field as it is now.
    pub(super) fn field(&self) -> DynamicGaussians {
        self.feed.lock().unwrap_or_else(PoisonError::into_inner).1.clone()
    }

    /// Runs some iterations towards `until`, and ends the fit after `end` of them; returns their losses.
    ///
    /// # Errors
    /// As [`GaussianFit::advance`].
    pub(super) fn advance(&mut self, until: u32, end: u32) -> Result<Vec<f64>> {
        let Some(fit) = &mut self.fit else { return Ok(Vec::new()) };
        let losses = fit.advance(until.min(end))?;
        self.shows_earlier &= !fit.is_presentable(end);
        if self.shows_earlier {
            return Ok(losses);
        }
        let field = fit.field()?;
        if fit.step() >= end {
            self.fit = None;
        }
        let mut feed = self.feed.lock().unwrap_or_else(PoisonError::into_inner);
        *feed = (feed.0 + 1, field);
        Ok(losses)
    }

    /// Line integrals of the plan's images less those of the field: `[frame][pixel]`.
    ///
    /// # Errors
    /// Device errors.
    pub(super) fn what_remains(&self, gpu: &Gpu, plan: &Plan) -> Result<Vec<f32>> {
        let pictures = Pictures::new(gpu, &self.field())?;
        let (width, pixels) = (plan.setup.image_width as usize, plan.setup.n_pixels as usize);
        let mut remains = plan.images.clone();
        for ((rays, phases), image) in self.shots.iter().zip(remains.chunks_mut(pixels)) {
            let seen = pictures.draw_at(rays, (width, pixels / width), *phases)?;
            image.iter_mut().zip(seen).for_each(|(y, seen)| *y -= seen);
        }
        Ok(remains)
    }
}
