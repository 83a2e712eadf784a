//! Fit of the Gaussians in the form that configuration and data ask for.

use crate::choice::Choice;
use crate::config::GaussianForm;
use crate::error::{Error, Result};
use crate::fitting::fit::{Advance, FitProgress, FitWork, Iterates, Measured};
use crate::fitting::losses::StepLoss;
use crate::gaussians::field::GaussianField;
use crate::gaussians::work::GaussianWork;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::methods::dynamic_gaussians::carried::{can_go_on, explains_all};
use crate::methods::dynamic_gaussians::deformable::{DeformableTrainer, Earlier};
use crate::methods::dynamic_gaussians::fine::Fine;
use crate::methods::dynamic_gaussians::made::Made;
use crate::methods::dynamic_gaussians::per_phase::GaussianTrainer;
use crate::methods::dynamic_gaussians::rules::Rules;
use crate::methods::dynamic_gaussians::start::DeformableStart;
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

    /// Tells whether the field of a fit of `end` iterations is worth more than one that was fitted to fewer frames. A fit starts again
    /// only where the earlier field does not explain a view or a phase, so that a set per phase is worth more already.
    pub(crate) fn is_presentable(&self, end: u32) -> bool {
        match self {
            GaussianFit::PerPhase(fit) => fit.step() >= end / 2,
            GaussianFit::Start(start, _) => start.has_set_per_phase(),
            GaussianFit::Deformable(..) | GaussianFit::Made(_) => true,
        }
    }

    /// Tells whether the fit uses coarser images so far.
    pub(crate) fn is_coarse(&self) -> bool {
        match self {
            GaussianFit::Start(_, fine) | GaussianFit::Deformable(_, fine) => fine.is_some(),
            GaussianFit::PerPhase(_) | GaussianFit::Made(_) => false,
        }
    }

    /// Iterations done.
    pub(crate) fn step(&self) -> u32 {
        match self {
            GaussianFit::PerPhase(fit) => fit.step(),
            GaussianFit::Start(..) => 0,
            GaussianFit::Deformable(fit, _) => fit.step(),
            GaussianFit::Made(fit) => fit.step(),
        }
    }

    /// Share done of the preparation before the first iteration; none when that has begun.
    pub(crate) fn preparation(&self) -> Option<f64> {
        match self {
            GaussianFit::Start(start, _) => Some(start.share()),
            GaussianFit::PerPhase(_) | GaussianFit::Deformable(..) | GaussianFit::Made(_) => None,
        }
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
            GaussianFit::Deformable(fit, _) => fit.take_findings(),
            GaussianFit::Made(fit) => fit.take_findings(),
            GaussianFit::PerPhase(_) | GaussianFit::Start(..) => Vec::new(),
        }
    }

    /// Number of Gaussians.
    pub(crate) fn count(&self) -> u32 {
        match self {
            GaussianFit::PerPhase(fit) => fit.count(),
            GaussianFit::Start(start, _) => start.count(),
            GaussianFit::Deformable(fit, _) => fit.count(),
            GaussianFit::Made(fit) => fit.field().rows().rows.len() as u32,
        }
    }

    /// Name of the form of the field that it fits.
    fn form(&self) -> &'static str {
        match self {
            GaussianFit::PerPhase(_) => GaussianForm::Phase.name(),
            GaussianFit::Start(..) | GaussianFit::Deformable(..) => GaussianForm::Deformable.name(),
            GaussianFit::Made(fit) => fit.field().form(),
        }
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// Device errors.
    pub(crate) fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        match self {
            GaussianFit::PerPhase(fit) => fit.profile_step(),
            GaussianFit::Start(..) => Err(not_begun()),
            GaussianFit::Deformable(fit, _) => fit.profile_step(),
            GaussianFit::Made(_) => Err(not_begun()),
        }
    }

    /// Work of the last iteration.
    ///
    /// # Errors
    /// Device errors.
    pub(crate) fn work(&self) -> Result<GaussianWork> {
        match self {
            GaussianFit::PerPhase(fit) => fit.work(),
            GaussianFit::Start(..) => Err(not_begun()),
            GaussianFit::Deformable(fit, _) => fit.work(),
            GaussianFit::Made(_) => Err(not_begun()),
        }
    }
}

fn not_begun() -> Error {
    Error::Internal("no iteration of the Gaussians is under way".into())
}

impl Iterates for GaussianFit {
    fn progress(&self) -> FitProgress {
        FitProgress { preparation: self.preparation(), ..FitProgress::at(self.step()) }
    }

    fn advance(&mut self, until: u32) -> Result<Advance> {
        let first = self.step() + 1;
        let losses = GaussianFit::advance(self, until)?.into_iter().zip(first..);
        Ok(Advance::of(losses.map(|(loss, step)| StepLoss::of_gaussians(step, loss)).collect()))
    }
}

impl Measured for GaussianFit {
    fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        GaussianFit::profile_step(self)
    }

    fn work(&self) -> Result<Option<FitWork>> {
        let form = Some(self.form());
        Ok(Some(FitWork { form, count: self.count(), work: GaussianFit::work(self)? }))
    }
}
