//! Fit of a run: Gaussians first, then the static field on what they leave of the images.

use crate::error::Result;
use crate::fields::trainer::{FieldsFit, SavedFields};
use crate::fitting::fit::{
    Advance, FieldFeed, Fit, FitField, FitProgress, FitStart, Iterates, Measured, PendingFit, SavedFit, Use,
};
use crate::fitting::ledger::Ledger;
use crate::fitting::losses::{SMALLER_STEPS, StepLoss};
use crate::gaussians::field::{GaussianFeed, GaussianField};
use crate::gaussians::pictures::Pictures;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::methods::dynamic_gaussians::data::{GaussianData, Shot};
use crate::methods::dynamic_gaussians::fit::Position;
use crate::methods::dynamic_gaussians::repeated::Repeated;
use crate::methods::dynamic_gaussians::rules::Rules;
use std::sync::{Arc, Mutex, PoisonError};

/// Gaussians of a run, and the static field behind them.
pub struct GaussiansFit {
    gpu: Gpu,
    /// Fits of the Gaussians, until their iterations are done; the static field begins then.
    gaussians: Option<Repeated>,
    feed: GaussianFeed,
    /// Whether the field of earlier data is shown, until the fit has a better one.
    shows_earlier: bool,
    /// Circumstances of each training image.
    shots: Vec<Shot>,
    fields: FieldsFit,
    /// Findings about the data that were made before the first submit.
    findings: Vec<String>,
}

impl GaussiansFit {
    /// Begins a fit, or takes over what was saved of one to the same data. A fit of Gaussians that was saved half way is repeated up
    /// to there: that takes seconds and gives the same bits, however many iterations go into a submit (except for one that had gone
    /// on from an earlier deformable set, which begins from seeds). Gaussians that were fitted to other data are shown, and gone on
    /// from, where they can be.
    ///
    /// # Errors
    /// Errors of [`Repeated::new`] and [`FieldsFit::new`].
    pub(crate) fn new(data: GaussianData, start: &FitStart<'_>) -> Result<GaussiansFit> {
        let GaussianData { targets, fields, shots } = data;
        let (gpu, config, from) = (start.gpu, &Rules::of(&start.config.of()?), start.from);
        let gaussians_to = |wanted| from.field_to(wanted).and_then(|field| field.gaussians.as_ref());
        let (earlier, saved_fields) = (gaussians_to(Use::GoOn), SavedFields::at(from));
        let done = saved_fields.filter(|_| from.field_to(Use::Resume).is_some()).map_or(0, |saved| saved.step());
        let (end, mut findings) = (config.gaussian_iterations(), Vec::new());
        let (gaussians, field) = match gaussians_to(Use::Resume).filter(|_| done >= end) {
            Some(field) => (None, field.clone()),
            None => {
                let made = from.made.and_then(|made| made.downcast_ref());
                let mut fit = Repeated::new(gpu, targets, config, earlier, made)?;
                while fit.position().step < done {
                    findings.append(&mut fit.advance(done)?.1);
                }
                let field = fit.field()?;
                (Some(fit), field)
            }
        };
        let shown = earlier.or(gaussians_to(Use::Show));
        let shown = shown.filter(|_| gaussians.as_ref().is_some_and(|fit| !fit.position().is_presentable));
        let shows_earlier = shown.is_some();
        let done = match &gaussians {
            Some(fit) => fit.position().step,
            None => saved_fields.map_or(0, |saved| saved.step()),
        };
        let fields = FieldsFit::awaiting_images(gpu, fields, start.tuning.clone(), saved_fields, done)?;
        let mut fit = GaussiansFit {
            gpu: gpu.clone(),
            gaussians,
            feed: Arc::new(Mutex::new((0, shown.cloned().unwrap_or(field)))),
            shows_earlier,
            shots,
            fields,
            findings,
        };
        // A field that was fitted before has left its images already.
        if fit.gaussians.is_none() {
            fit.set_remaining_images()?;
        }
        Ok(fit)
    }

    /// Returns the static field, for tests.
    pub fn fields(&self) -> &FieldsFit {
        &self.fields
    }

    /// Returns the Gaussians as they are shown now.
    fn field(&self) -> GaussianField {
        self.feed.lock().unwrap_or_else(PoisonError::into_inner).1.clone()
    }

    /// Runs some iterations of the Gaussians towards `until`, and ends their fit after `end` iterations.
    fn advance_gaussians(&mut self, until: u32, end: u32) -> Result<Advance> {
        let Some(fit) = &mut self.gaussians else { return Ok(Advance::default()) };
        let was_coarse = fit.position().is_coarse;
        let (losses, found) = fit.advance(until.min(end))?;
        let Position { step, is_coarse, is_presentable, .. } = fit.position();
        let has_new_objective = was_coarse && !is_coarse;
        self.shows_earlier &= !is_presentable;
        if !self.shows_earlier {
            let field = fit.field()?;
            if step >= end {
                self.gaussians = None;
            }
            let mut feed = self.feed.lock().unwrap_or_else(PoisonError::into_inner);
            *feed = (feed.0 + 1, field);
        }
        let first = self.fields.progress().step + 1;
        self.fields.count(losses.len() as u32);
        let losses = losses.into_iter().zip(first..).map(|(loss, step)| StepLoss::of_gaussians(step, loss)).collect();
        let findings = std::mem::take(&mut self.findings).into_iter().chain(found).collect();
        let smaller_steps = (has_new_objective || self.gaussians.is_none()).then_some(SMALLER_STEPS);
        Ok(Advance { losses, smaller_steps, findings })
    }

    /// Gives the static field the line integrals of the images less those of the Gaussians.
    fn set_remaining_images(&mut self) -> Result<()> {
        let pictures = Pictures::as_imaged(&self.gpu, &self.field())?;
        let data = self.fields.data();
        let (width, pixels) = (data.setup.image_width as usize, data.setup.n_pixels as usize);
        let (images, shots) = (data.images.clone(), &self.shots);
        self.fields.set_images(|frame| {
            let shot = &shots[frame];
            let drawn = pictures.draw_at(&shot.rays, (width, pixels / width), shot.phases)?;
            Ok(images[frame].iter().zip(drawn).map(|(y, drawn)| y - shot.contrast * drawn).collect())
        })
    }
}

impl Iterates for GaussiansFit {
    fn progress(&self) -> FitProgress {
        let preparation = self.gaussians.as_ref().and_then(|fit| fit.position().preparation);
        FitProgress { preparation, shows_earlier: self.shows_earlier, ..self.fields.progress() }
    }

    fn advance(&mut self, until: u32) -> Result<Advance> {
        if self.gaussians.is_none() || self.fields.progress().step >= until {
            return self.fields.advance(until);
        }
        let end = self.fields.data().settings.begin;
        let advance = self.advance_gaussians(until, end)?;
        if self.gaussians.is_none() {
            self.set_remaining_images()?;
        }
        Ok(advance)
    }
}

impl Fit for GaussiansFit {
    fn outline(&self) -> FitField {
        FitField::of_gaussians(self.field())
    }

    fn feed(&self) -> FieldFeed {
        let params_fixed_until = self.fields.data().settings.begin;
        FieldFeed { params_fixed_until, gaussians: Some(self.feed.clone()), ..self.fields.feed() }
    }

    fn snapshot(&self) -> Result<PendingFit> {
        let (fields, gaussians) = (self.fields.pending()?, self.field());
        Ok(Box::new(|| {
            let SavedFit { field, state } = fields.wait()?;
            // Gaussians need no hull once they are seeded.
            Ok(SavedFit { field: FitField { gaussians: Some(gaussians), hull: None, ..field }, state })
        }))
    }

    fn measured(&mut self) -> Option<&mut dyn Measured> {
        Some(self)
    }
}

impl Measured for GaussiansFit {
    fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        if self.gaussians.is_some() {
            // The static field has no images before the Gaussians are fitted; its passes take as long with those that the run has.
            let images = self.fields.data().images.clone();
            self.fields.set_images(|frame| Ok(images[frame].clone()))?;
        }
        self.fields.profile_step()
    }

    fn barriers(&self) -> Option<u32> {
        self.fields.barriers()
    }

    fn ledger(&self, live_samples: u64) -> Ledger {
        self.fields.ledger(live_samples)
    }
}
