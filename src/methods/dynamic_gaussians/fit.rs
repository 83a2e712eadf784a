//! Fit of the Gaussians in the form that configuration and data ask for.

pub mod carried;
pub(crate) mod fine;

use crate::choice::Choice;
use crate::config::GaussianForm;
use crate::error::{Error, Result};
use crate::fitting::fit::{Advance, FitProgress, FitWork, Iterates, Measured};
use crate::fitting::losses::StepLoss;
use crate::gaussians::field::GaussianField;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::methods::dynamic_gaussians::deformable::start::DeformableStart;
use crate::methods::dynamic_gaussians::deformable::{DeformableTrainer, Earlier};
use crate::methods::dynamic_gaussians::fit::carried::{can_go_on, explains_all};
use crate::methods::dynamic_gaussians::fit::fine::Fine;
use crate::methods::dynamic_gaussians::made::Made;
use crate::methods::dynamic_gaussians::per_phase::GaussianTrainer;
use crate::methods::dynamic_gaussians::rules::Rules;
use crate::methods::dynamic_gaussians::targets::Targets;

/// A fit under way.
pub(crate) enum GaussianFit {
    /// A set per phase.
    PerPhase(Box<GaussianTrainer>),
    /// One set for the beat, in preparation; with the images that its fit ends on, where it begins on coarser ones.
    Start(Box<DeformableStart>, Option<Box<Fine>>),
    /// One set for the beat, likewise.
    Deformable(Box<DeformableTrainer>, Option<Box<Fine>>),
    /// A fit that was made before.
    Made(Box<Made>),
}

/// Position of a fit of Gaussians.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Position {
    /// Iterations done.
    pub(crate) step: u32,
    /// Share done of the preparation before the first iteration; none when that has begun.
    pub(crate) preparation: Option<f64>,
    /// Whether the fit uses coarser images so far.
    pub(crate) is_coarse: bool,
    /// Whether the field is worth more than one that was fitted to fewer frames.
    pub(crate) is_presentable: bool,
}

impl GaussianFit {
    /// Begins a fit of the form that configuration and data ask for. One set for the beat goes on from an earlier field where that is of
    /// use, or takes its motion.
    ///
    /// # Errors
    /// As [`GaussianTrainer::new`], [`DeformableStart::new`] and [`DeformableTrainer::with`].
    pub(crate) fn new(
        gpu: &Gpu,
        mut targets: Targets,
        config: &Rules,
        earlier: Option<Earlier<'_>>,
    ) -> Result<GaussianFit> {
        if targets.form(config.form) != GaussianForm::Deformable {
            return Ok(GaussianFit::PerPhase(Box::new(GaussianTrainer::new(gpu, targets, config)?)));
        }
        match earlier.filter(|earlier| !earlier.field.rest.rows.is_empty()) {
            Some(earlier) if earlier.reseeds => {
                let (targets, fine) = Fine::split(gpu, targets, config);
                let fit = DeformableTrainer::after(gpu, targets, config, earlier)?;
                return Ok(GaussianFit::Deformable(Box::new(fit), fine));
            }
            Some(earlier) if can_go_on(&targets, config, earlier.field) => {
                let fit = DeformableTrainer::after(gpu, targets, config, earlier)?;
                if explains_all(&fit)? {
                    return Ok(GaussianFit::Deformable(Box::new(fit), None));
                }
                targets = fit.into_targets();
            }
            _ => {}
        }
        let (targets, fine) = Fine::split(gpu, targets, config);
        Ok(GaussianFit::Start(Box::new(DeformableStart::new(gpu, targets, config)?), fine))
    }

    /// Returns the position of the fit, which ends after `end` iterations.
    pub(crate) fn position(&self, end: u32) -> Position {
        let is_coarse = |fine: &Option<Box<Fine>>| fine.is_some();
        let (step, preparation, is_coarse, is_presentable) = match self {
            // A fit starts again only where the earlier field does not explain a view or a phase.
            GaussianFit::PerPhase(fit) => (fit.step(), None, false, fit.step() >= end / 2),
            GaussianFit::Start(start, fine) => (0, Some(start.share()), is_coarse(fine), start.has_set_per_phase()),
            GaussianFit::Deformable(fit, fine) => (fit.step(), None, is_coarse(fine), true),
            GaussianFit::Made(fit) => (fit.step(), None, false, true),
        };
        Position { step, preparation, is_coarse, is_presentable }
    }

    /// Runs some iterations towards `until`; returns their losses, none while a deformable set is in preparation.
    ///
    /// # Errors
    /// As [`GaussianTrainer::advance`] and [`DeformableStart::advance`].
    pub(crate) fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        match self {
            GaussianFit::PerPhase(fit) => fit.advance(until),
            GaussianFit::Start(start, fine) => {
                if let Some(deformable) = start.advance()? {
                    *self = GaussianFit::Deformable(Box::new(deformable), fine.take());
                }
                Ok(Vec::new())
            }
            GaussianFit::Deformable(fit, fine) => {
                let from = fine.as_ref().map_or(u32::MAX, |fine| fine.from());
                if fit.step() >= from
                    && let Some(fine) = fine.take()
                {
                    **fit = fine.go_on(fit)?;
                    return fit.advance(until);
                }
                fit.advance(until.min(from))
            }
            GaussianFit::Made(fit) => Ok(fit.advance(until)),
        }
    }

    /// The field after the iterations done.
    ///
    /// # Errors
    /// As [`GaussianTrainer::model`].
    pub(crate) fn field(&self) -> Result<GaussianField> {
        Ok(match self {
            GaussianFit::PerPhase(fit) => GaussianField::PerPhase(fit.model()?),
            GaussianFit::Start(start, _) => GaussianField::PerPhase(start.field()?),
            GaussianFit::Deformable(fit, _) => GaussianField::Moving(fit.deformable()?),
            GaussianFit::Made(fit) => fit.field().clone(),
        })
    }

    /// Returns findings about the data since the last call, for the user.
    pub(crate) fn take_findings(&mut self) -> Vec<String> {
        match self {
            GaussianFit::Deformable(fit, _) => fit.take_finding().into_iter().collect(),
            GaussianFit::Made(fit) => fit.take_findings(),
            GaussianFit::PerPhase(_) | GaussianFit::Start(..) => Vec::new(),
        }
    }
}

fn not_begun() -> Error {
    Error::Internal("no iteration of the Gaussians is under way".into())
}

impl Iterates for GaussianFit {
    fn progress(&self) -> FitProgress {
        let Position { step, preparation, .. } = self.position(u32::MAX);
        FitProgress { preparation, ..FitProgress::at(step) }
    }

    fn advance(&mut self, until: u32) -> Result<Advance> {
        let first = self.progress().step + 1;
        let losses = GaussianFit::advance(self, until)?.into_iter().zip(first..);
        Ok(Advance::of(losses.map(|(loss, step)| StepLoss::of_gaussians(step, loss)).collect()))
    }
}

impl Measured for GaussianFit {
    fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        match self {
            GaussianFit::PerPhase(fit) => fit.profile_step(),
            GaussianFit::Deformable(fit, _) => fit.profile_step(),
            GaussianFit::Start(..) | GaussianFit::Made(_) => Err(not_begun()),
        }
    }

    fn work(&self) -> Result<Option<FitWork>> {
        let (form, count, work) = match self {
            GaussianFit::PerPhase(fit) => (GaussianForm::Phase, fit.count(), fit.work()?),
            GaussianFit::Deformable(fit, _) => (GaussianForm::Deformable, fit.count(), fit.work()?),
            GaussianFit::Start(..) | GaussianFit::Made(_) => return Err(not_begun()),
        };
        Ok(Some(FitWork { form: Some(form.name()), count, work }))
    }
}
