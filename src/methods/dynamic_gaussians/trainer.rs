//! Fit of a run: Gaussians first, then the static field on what they leave of the images.

use crate::error::Result;
use crate::fields::state::PendingBehind;
use crate::fields::trainer::{FieldsFit, SavedFields};
use crate::fitting::fit::{Beginning, FieldFeed, Fit, FitField, FitStart, PendingFit, PreparedGaussians};
use crate::fitting::ledger::Ledger;
use crate::fitting::losses::{SMALLER_STEPS, StepLoss};
use crate::gaussians::field::{DynamicGaussians, GaussianFeed};
use crate::gaussians::pictures::Pictures;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::kernels::tuning::Tuning;
use crate::methods::dynamic_gaussians::data::{GaussianData, Shot};
use crate::methods::dynamic_gaussians::fit::GaussianFit;
use crate::methods::dynamic_gaussians::repeated::Repeated;
use crate::methods::dynamic_gaussians::rules::Rules;
use std::any::Any;
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
    /// Whether, since the last call of [`Fit::new_objective`], the static field or the fit to all pixels has begun.
    has_new_objective: bool,
    /// Findings about the data that were not taken yet.
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
        let (gpu, config) = (start.gpu, &Rules::of(&start.config.of()?));
        let resumed = start.from.resumed();
        let earlier = match start.from {
            Beginning::CarriedOn(saved) => saved.field.gaussians.as_ref(),
            Beginning::AfterGaussians(gaussians) => Some(gaussians),
            Beginning::Scratch | Beginning::Prepared(_) | Beginning::Resumed(_) => None,
        };
        let prepared = match start.from {
            Beginning::Prepared(prepared) => prepared,
            _ => PreparedGaussians::default(),
        };
        let done = resumed.and_then(SavedFields::of).map_or(0, |saved| saved.step());
        let end = config.gaussian_iterations();
        let saved = resumed.and_then(|saved| saved.field.gaussians.as_ref());
        let (gaussians, field) = match saved.filter(|_| done >= end) {
            Some(field) => (None, field.clone()),
            None => {
                let mut fit = match earlier {
                    Some(earlier) => Repeated::once(gpu, config, GaussianFit::after(gpu, targets, config, earlier)?),
                    None => Repeated::new(gpu, targets, config, prepared.made)?,
                };
                while fit.step() < done {
                    fit.advance(done)?;
                }
                let field = fit.field()?;
                (Some(fit), field)
            }
        };
        let shown =
            earlier.or(prepared.shown).filter(|_| gaussians.as_ref().is_some_and(|fit| !fit.is_presentable(end)));
        let shows_earlier = shown.is_some();
        let saved_fields = SavedFields::at(start.from);
        let done = match &gaussians {
            Some(fit) => fit.step(),
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
            has_new_objective: false,
            findings: Vec::new(),
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
    fn field(&self) -> DynamicGaussians {
        self.feed.lock().unwrap_or_else(PoisonError::into_inner).1.clone()
    }

    /// Runs some iterations of the Gaussians towards `until`, and ends their fit after `end` iterations; returns their losses.
    fn advance_gaussians(&mut self, until: u32, end: u32) -> Result<Vec<f64>> {
        let Some(fit) = &mut self.gaussians else { return Ok(Vec::new()) };
        let was_coarse = fit.is_coarse();
        let losses = fit.advance(until.min(end))?;
        self.findings.extend(fit.take_findings());
        self.has_new_objective |= was_coarse && !fit.is_coarse();
        self.shows_earlier &= !fit.is_presentable(end);
        if self.shows_earlier {
            return Ok(losses);
        }
        let field = fit.field()?;
        if fit.step() >= end {
            self.gaussians = None;
        }
        let mut feed = self.feed.lock().unwrap_or_else(PoisonError::into_inner);
        *feed = (feed.0 + 1, field);
        Ok(losses)
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

impl Fit for GaussiansFit {
    fn step(&self) -> u32 {
        self.fields.step()
    }

    fn submitted(&self) -> u32 {
        self.fields.submitted()
    }

    fn preparation(&self) -> Option<f64> {
        self.gaussians.as_ref().and_then(Repeated::preparation)
    }

    fn shows_earlier(&self) -> bool {
        self.shows_earlier
    }

    fn advance(&mut self, until: u32) -> Result<Vec<StepLoss>> {
        if self.gaussians.is_none() || self.fields.step() >= until {
            return self.fields.advance(until);
        }
        let end = self.fields.data().settings.begin;
        let losses = self.advance_gaussians(until, end)?;
        if self.gaussians.is_none() {
            self.set_remaining_images()?;
            self.has_new_objective = true;
        }
        let first = self.fields.step() + 1;
        self.fields.count(losses.len() as u32);
        Ok(losses.into_iter().zip(first..).map(|(loss, step)| StepLoss::of_gaussians(step, loss)).collect())
    }

    fn new_objective(&mut self) -> Option<&'static str> {
        std::mem::take(&mut self.has_new_objective).then_some(SMALLER_STEPS)
    }

    fn take_findings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.findings)
    }

    fn outline(&self) -> FitField {
        FitField::of_gaussians(self.field())
    }

    fn feed(&self) -> FieldFeed {
        let params_fixed_until = self.fields.data().settings.begin;
        FieldFeed { params_fixed_until, gaussians: Some(self.feed.clone()), ..self.fields.feed() }
    }

    fn snapshot(&self) -> Result<Box<dyn PendingFit>> {
        Ok(Box::new(PendingBehind { fields: Box::new(self.fields.pending()?), gaussians: self.field() }))
    }

    fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        if self.gaussians.is_some() {
            // The static field has no images before the Gaussians are fitted; its passes take as long with those that the run has.
            let images = self.fields.data().images.clone();
            self.fields.set_images(|frame| Ok(images[frame].clone()))?;
        }
        self.fields.profile_step()
    }

    fn tuning(&self) -> Option<&Tuning> {
        self.fields.tuning()
    }

    fn barriers(&self) -> Option<u32> {
        self.fields.barriers()
    }

    fn ledger(&self, live_samples: u64) -> Ledger {
        self.fields.ledger(live_samples)
    }

    fn as_any(&self) -> &dyn Any {
        self
    }
}
