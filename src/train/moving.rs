//! Gaussians of a run: their fit, and what they leave of the images to the static field.

use crate::config::{Config, GaussianForm};
use crate::error::{Error, Result};
use crate::gaussians::pictures::Pictures;
use crate::gaussians::work::GaussianWork;
use crate::geometry::ViewRays;
use crate::gpu::device::Gpu;
use crate::gpu::record::PassTime;
use crate::model::checkpoint::Checkpoint;
use crate::model::gaussians::{MovingFeed, MovingGaussians};
use crate::model::r2::R2State;
use crate::model::x_gaussian::XState;
use crate::plan::Plan;
use crate::plan::targets::Targets;
use crate::r2::data::R2Data;
use crate::scan::dataset::{Dataset, Frame};
use crate::train::carried::Carried;
use crate::train::gaussians::GaussianTrainer;
use crate::train::r2::R2Trainer;
use crate::train::tree::TreeTrainer;
use crate::train::tree_start::TreeStart;
use crate::train::x_gaussian::XTrainer;
use crate::x_gaussian::data::XData;
use std::sync::{Arc, Mutex, PoisonError};

/// Iterations of R2-Gaussian and X-Gaussian between updates of the field that is drawn: with half a million Gaussians per phase
/// an update takes as long as some iterations.
const SHOWN_EVERY: u32 = 100;

/// Data that Gaussians are fitted to.
#[derive(Clone)]
pub(super) enum FitData {
    /// Bounds of the dynamic field's images.
    Targets(Box<Targets>),
    /// Whole images.
    R2(Box<R2Data>),
    /// Whole images, normalised.
    X(Box<XData>),
}

impl FitData {
    /// Takes the fit data of a plan; none where a network is the dynamic field.
    pub(super) fn take(plan: &mut Plan) -> Option<FitData> {
        let r2 = plan.r2.take().map(|data| FitData::R2(Box::new(data)));
        let x = plan.x.take().map(|data| FitData::X(Box::new(data)));
        r2.or(x).or_else(|| plan.targets.take().map(|targets| FitData::Targets(Box::new(targets))))
    }
}

/// A fit under way.
pub(super) enum MovingFit {
    /// A set per phase.
    PerPhase(Box<GaussianTrainer>),
    /// One set for the beat, in preparation.
    Start(Box<TreeStart>),
    /// One set for the beat.
    Tree(Box<TreeTrainer>),
    /// Static sets as R2-Gaussian fits them.
    R2(Box<R2Trainer>),
    /// Static sets as X-Gaussian fits them.
    X(Box<XTrainer>),
}

impl MovingFit {
    /// Begins a fit; returns it, and notes about its beginning for the user.
    ///
    /// # Errors
    /// As [`R2Trainer::new`], [`XTrainer::new`], [`GaussianTrainer::new`] and [`TreeStart::new`].
    pub(super) fn of(gpu: &Gpu, data: FitData, config: &Config) -> Result<(MovingFit, Vec<String>)> {
        Ok(match data {
            FitData::Targets(targets) => (MovingFit::new(gpu, *targets, config)?, Vec::new()),
            FitData::R2(data) => {
                let (fit, notes) = R2Trainer::new(gpu, *data, config)?;
                (MovingFit::R2(Box::new(fit)), notes)
            }
            FitData::X(data) => {
                let (fit, notes) = XTrainer::new(gpu, *data, config)?;
                (MovingFit::X(Box::new(fit)), notes)
            }
        })
    }

    /// Begins a fit of the form that configuration and data ask for.
    ///
    /// # Errors
    /// As [`GaussianTrainer::new`] and [`TreeStart::new`].
    fn new(gpu: &Gpu, targets: Targets, config: &Config) -> Result<MovingFit> {
        Ok(match targets.form(config.gaussians.form) {
            GaussianForm::Tree => MovingFit::Start(Box::new(TreeStart::new(gpu, targets, config)?)),
            _ => MovingFit::PerPhase(Box::new(GaussianTrainer::new(gpu, targets, config)?)),
        })
    }

    /// As [`MovingFit::new`], but goes on from what was fitted to `earlier` data where that is of use.
    ///
    /// # Errors
    /// As [`MovingFit::new`] and [`Carried::new`].
    fn after(gpu: &Gpu, mut targets: Targets, config: &Config, earlier: &MovingGaussians) -> Result<MovingFit> {
        if let (GaussianForm::Tree, Some(tree)) = (targets.form(config.gaussians.form), earlier.tree()) {
            match Carried::new(gpu, targets, config, tree)? {
                Carried::On(fit) => return Ok(MovingFit::Tree(fit)),
                Carried::Anew(same) => targets = *same,
            }
        }
        MovingFit::new(gpu, targets, config)
    }

    /// Tells whether the field of a fit of `end` iterations is worth more than one that was fitted to fewer frames.
    fn is_presentable(&self, end: u32) -> bool {
        match self {
            MovingFit::PerPhase(fit) => fit.step() >= end / 2,
            MovingFit::Start(_) => false,
            MovingFit::Tree(_) | MovingFit::R2(_) | MovingFit::X(_) => true,
        }
    }

    /// Iterations done.
    pub(super) fn step(&self) -> u32 {
        match self {
            MovingFit::PerPhase(fit) => fit.step(),
            MovingFit::Start(_) => 0,
            MovingFit::Tree(fit) => fit.step(),
            MovingFit::R2(fit) => fit.step(),
            MovingFit::X(fit) => fit.step(),
        }
    }

    /// Share done of the preparation before the first iteration; none when that has begun.
    pub(super) fn preparation(&self) -> Option<f64> {
        match self {
            MovingFit::Start(start) => Some(start.share()),
            MovingFit::PerPhase(_) | MovingFit::Tree(_) | MovingFit::R2(_) | MovingFit::X(_) => None,
        }
    }

    /// Runs some iterations towards `until`; returns their losses, none while a tree is in preparation.
    ///
    /// # Errors
    /// As [`GaussianTrainer::advance`] and [`TreeStart::advance`].
    pub(super) fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        match self {
            MovingFit::PerPhase(fit) => fit.advance(until),
            MovingFit::Start(start) => {
                if let Some(tree) = start.advance()? {
                    *self = MovingFit::Tree(Box::new(tree));
                }
                Ok(Vec::new())
            }
            MovingFit::Tree(fit) => fit.advance(until),
            MovingFit::R2(fit) => fit.advance(until),
            MovingFit::X(fit) => fit.advance(until),
        }
    }

    /// The field after the iterations done.
    ///
    /// # Errors
    /// As [`GaussianTrainer::model`].
    pub(super) fn field(&self) -> Result<MovingGaussians> {
        Ok(match self {
            MovingFit::PerPhase(fit) => MovingGaussians::PerPhase(fit.model()?),
            MovingFit::Start(start) => MovingGaussians::PerPhase(start.field()?),
            MovingFit::Tree(fit) => MovingGaussians::Tree(fit.tree()?),
            MovingFit::R2(fit) => MovingGaussians::PerPhase(fit.model()?),
            MovingFit::X(fit) => MovingGaussians::PerPhase(fit.model()?),
        })
    }

    /// Number of Gaussians.
    pub(super) fn count(&self) -> u32 {
        match self {
            MovingFit::PerPhase(fit) => fit.count(),
            MovingFit::Start(start) => start.count(),
            MovingFit::Tree(fit) => fit.count(),
            MovingFit::R2(fit) => fit.count(),
            MovingFit::X(fit) => fit.count(),
        }
    }

    /// Form of the field that it fits.
    pub(super) fn form(&self) -> GaussianForm {
        match self {
            MovingFit::PerPhase(_) => GaussianForm::Phase,
            MovingFit::Start(_) | MovingFit::Tree(_) => GaussianForm::Tree,
            MovingFit::R2(_) => GaussianForm::R2,
            MovingFit::X(_) => GaussianForm::X,
        }
    }

    /// Runs one iteration with a timestamp around each pass.
    ///
    /// # Errors
    /// Device errors.
    pub(super) fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        match self {
            MovingFit::PerPhase(fit) => fit.profile_step(),
            MovingFit::Start(_) => Err(not_begun()),
            MovingFit::Tree(fit) => fit.profile_step(),
            MovingFit::R2(fit) => fit.profile_step(),
            MovingFit::X(fit) => fit.profile_step(),
        }
    }

    /// Work of the last iteration.
    ///
    /// # Errors
    /// Device errors.
    pub(super) fn work(&self) -> Result<GaussianWork> {
        match self {
            MovingFit::PerPhase(fit) => fit.work(),
            MovingFit::Start(_) => Err(not_begun()),
            MovingFit::Tree(fit) => fit.work(),
            MovingFit::R2(fit) => fit.work(),
            MovingFit::X(fit) => fit.work(),
        }
    }
}

fn not_begun() -> Error {
    Error::Internal("the iterations of the deformable set have not begun".into())
}

/// The dynamic field of a run, where it is made of Gaussians.
pub(super) struct Moving {
    /// Fit, until its iterations are done; the static field begins then.
    fit: Option<MovingFit>,
    feed: MovingFeed,
    /// Whether the field of earlier data is shown, until the fit has a better one.
    shows_earlier: bool,
    /// View of each training image, and its time, counted in phases.
    shots: Vec<(ViewRays, f64)>,
}

impl Moving {
    /// Begins a fit to the plan's targets, or takes over what was `saved` of one to the same targets; none where a network is
    /// the dynamic field. A fit that was saved half way is repeated up to there: that takes seconds and gives the same bits,
    /// however many iterations go into a submit (except for one that had gone on from an earlier tree, which begins from
    /// seeds). A field that was fitted to `earlier` data is shown, and gone on from, where it can be.
    ///
    /// # Errors
    /// As [`MovingFit::new`], and as [`TreeStart::advance`] for what is done again.
    pub(super) fn begin(
        gpu: &Gpu,
        plan: &mut Plan,
        dataset: &Dataset,
        saved: Option<&Checkpoint>,
        earlier: Option<&MovingGaussians>,
        per_submit: u32,
    ) -> Result<Option<Moving>> {
        let mut config = plan.config.clone();
        config.train.iterations_per_submit = per_submit;
        if let Some(data) = plan.r2.take() {
            return Self::begin_r2(gpu, data, &config, saved, &mut plan.notes).map(Some);
        }
        if let Some(data) = plan.x.take() {
            return Self::begin_x(gpu, data, &config, saved, &mut plan.notes).map(Some);
        }
        let Some(targets) = plan.targets.take() else { return Ok(None) };
        let shot = |frame: &Frame| (dataset.heart_rays(frame), frame.beat_time().phases(dataset.n_phases));
        let saved = saved.map(|saved| &saved.model);
        let (done, end) = (saved.map_or(0, |model| model.step), config.gaussian_iterations());
        let (fit, field) = match saved.and_then(|model| model.moving.as_ref()).filter(|_| done >= end) {
            Some(field) => (None, field.clone()),
            None => {
                let mut fit = match earlier {
                    Some(earlier) => MovingFit::after(gpu, targets, &config, earlier)?,
                    None => MovingFit::new(gpu, targets, &config)?,
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
        Ok(Some(Moving { fit, feed, shows_earlier, shots }))
    }

    /// Begins R2-Gaussian's fit, or goes on from what was `saved` of one to the same images.
    fn begin_r2(
        gpu: &Gpu,
        data: R2Data,
        config: &Config,
        saved: Option<&Checkpoint>,
        notes: &mut Vec<String>,
    ) -> Result<Moving> {
        let fit = match saved.and_then(|saved| Some((saved.r2.as_ref()?, saved.model.step))) {
            Some((state, step)) => R2Trainer::with(gpu, data, config, state, step)?,
            None => {
                let (fit, more) = R2Trainer::new(gpu, data, config)?;
                notes.extend(more);
                fit
            }
        };
        let feed = Arc::new(Mutex::new((0, MovingGaussians::PerPhase(fit.model()?))));
        Ok(Moving { fit: Some(MovingFit::R2(Box::new(fit))), feed, shows_earlier: false, shots: Vec::new() })
    }

    /// Begins X-Gaussian's fit, or goes on from what was `saved` of one to the same images.
    fn begin_x(
        gpu: &Gpu,
        data: XData,
        config: &Config,
        saved: Option<&Checkpoint>,
        notes: &mut Vec<String>,
    ) -> Result<Moving> {
        let fit = match saved.and_then(|saved| Some((saved.x.as_ref()?, saved.model.step))) {
            Some((state, step)) => XTrainer::with(gpu, data, config, state, step)?,
            None => {
                let (fit, more) = XTrainer::new(gpu, data, config)?;
                notes.extend(more);
                fit
            }
        };
        let feed = Arc::new(Mutex::new((0, MovingGaussians::PerPhase(fit.model()?))));
        Ok(Moving { fit: Some(MovingFit::X(Box::new(fit))), feed, shows_earlier: false, shots: Vec::new() })
    }

    /// The state of X-Gaussian's fit, and the field it stands for; none of other fits.
    ///
    /// # Errors
    /// As [`XTrainer::state`].
    pub(super) fn x_state(&self) -> Result<Option<(XState, MovingGaussians)>> {
        let Some(MovingFit::X(fit)) = &self.fit else { return Ok(None) };
        let state = fit.state()?;
        let field = MovingGaussians::PerPhase(fit.field_of(&state));
        Ok(Some((state, field)))
    }

    /// The state of R2-Gaussian's fit, and the field it stands for; none of other fits.
    ///
    /// # Errors
    /// As [`R2Trainer::state`].
    pub(super) fn r2_state(&self) -> Result<Option<(R2State, MovingGaussians)>> {
        let Some(MovingFit::R2(fit)) = &self.fit else { return Ok(None) };
        let state = fit.state()?;
        let field = MovingGaussians::PerPhase(fit.field_of(&state));
        Ok(Some((state, field)))
    }

    /// Runs one iteration of the fit with a timestamp around each pass.
    ///
    /// # Errors
    /// [`Error::Internal`] when the fit has ended; device errors.
    pub(super) fn profile_step(&mut self) -> Result<Vec<PassTime>> {
        self.fit.as_mut().ok_or_else(|| Error::Internal("the fit has ended".into()))?.profile_step()
    }

    /// Iterations done of a fit that is not finished.
    pub(super) fn step(&self) -> Option<u32> {
        self.fit.as_ref().map(MovingFit::step)
    }

    /// Share done of the preparation before the first iteration; none when that has begun.
    pub(super) fn preparation(&self) -> Option<f64> {
        self.fit.as_ref().and_then(MovingFit::preparation)
    }

    /// Tells whether iterations of the fit are left.
    pub(super) fn is_fitting(&self) -> bool {
        self.fit.is_some()
    }

    /// Feed for those who draw the field.
    pub(super) fn feed(&self) -> MovingFeed {
        self.feed.clone()
    }

    /// The field as it is now.
    pub(super) fn field(&self) -> MovingGaussians {
        self.feed.lock().unwrap_or_else(PoisonError::into_inner).1.clone()
    }

    /// Runs some iterations towards `until`, and ends the fit after `end` of them; returns their losses.
    ///
    /// # Errors
    /// As [`MovingFit::advance`].
    pub(super) fn advance(&mut self, until: u32, end: u32) -> Result<Vec<f64>> {
        let Some(fit) = &mut self.fit else { return Ok(Vec::new()) };
        let before = fit.step();
        let losses = fit.advance(until.min(end))?;
        self.shows_earlier &= !fit.is_presentable(end);
        let is_alone = matches!(fit, MovingFit::R2(_) | MovingFit::X(_));
        let is_shown = !is_alone || fit.step() >= until.min(end) || fit.step() / SHOWN_EVERY > before / SHOWN_EVERY;
        if self.shows_earlier || !is_shown {
            return Ok(losses);
        }
        let field = fit.field()?;
        // No static field follows R2-Gaussian and X-Gaussian.
        if fit.step() >= end && !is_alone {
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
