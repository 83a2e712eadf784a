//! Start of a deformable set: a set of Gaussians per phase, of which that of the rest phase becomes the deformable set; then the grid is
//! tracked from phase to phase.

use crate::error::{Error, Result};
use crate::gaussians::field::{Gaussians, mass};
use crate::gaussians::particles::Particles;
use crate::gpu::device::Gpu;
use crate::kernels::layout::Gaussian;
use crate::methods::dynamic_gaussians::deformable::stages::Track;
use crate::methods::dynamic_gaussians::deformable::{DeformableTrainer, Fit};
use crate::methods::dynamic_gaussians::per_phase::{GaussianTrainer, strong};
use crate::methods::dynamic_gaussians::rules::{GaussianRules, Rules, TAKE};
use crate::methods::dynamic_gaussians::targets::Targets;
use std::ops::Range;

/// A deformable set in preparation.
pub struct DeformableStart {
    gpu: Gpu,
    config: Rules,
    stage: Stage,
}

enum Stage {
    /// Fit of a set per phase, which yields the background as well.
    Warming(Box<GaussianTrainer>),
    /// Tracking of the grid from phase to phase.
    Tracking(Box<Tracking>),
    /// The deformable set has been handed over, or lost to an error.
    Over,
}

struct Tracking {
    trainer: DeformableTrainer,
    fit: Fit,
    /// Tracks that are left, the last one first.
    left: Vec<Track>,
    /// Field that is shown until every phase has been reached.
    meanwhile: Gaussians,
}

impl DeformableStart {
    /// Seeds a set of Gaussians per phase.
    ///
    /// # Errors
    /// As [`GaussianTrainer::new`].
    pub fn new(gpu: &Gpu, targets: Targets, config: &Rules) -> Result<DeformableStart> {
        // Strays are dropped when all iterations are done: a stray may find its vessel before.
        let warm =
            GaussianRules { iterations: config.deformable.warm_iterations, link: 0.0, ..config.gaussians.clone() };
        let warm = Rules { gaussians: warm, ..config.clone() };
        let warming = GaussianTrainer::new(gpu, targets, &warm)?;
        Ok(DeformableStart { gpu: gpu.clone(), config: config.clone(), stage: Stage::Warming(Box::new(warming)) })
    }

    /// Does some of the work, a submit or two; returns the deformable set when it is ready to be fitted as a whole.
    ///
    /// # Errors
    /// [`Error::Config`] when the phase of rest shows nothing; [`Error::Diverged`]; device errors.
    pub fn advance(&mut self) -> Result<Option<DeformableTrainer>> {
        let warm_iterations = self.config.deformable.warm_iterations;
        match std::mem::replace(&mut self.stage, Stage::Over) {
            Stage::Warming(mut first) if first.step() < warm_iterations => {
                first.advance(warm_iterations)?;
                self.stage = Stage::Warming(first);
            }
            Stage::Warming(first) => self.stage = Stage::Tracking(Box::new(self.plant(*first)?)),
            Stage::Tracking(mut under_way) => {
                let Some(track) = under_way.left.pop() else {
                    under_way.trainer.forget_momentum()?;
                    return Ok(Some(under_way.trainer));
                };
                let of_phase = under_way.meanwhile.at(track.phase as usize).copied();
                // Without an image, nothing is seen.
                let of_phase: Vec<Gaussian> = of_phase.filter(|_| !track.images.is_empty()).collect();
                let of_phase = under_way.trainer.targets().contrast_comes_and_goes.then_some(&of_phase[..]);
                under_way.trainer.track(&under_way.fit, &track, of_phase)?;
                self.stage = Stage::Tracking(under_way);
            }
            Stage::Over => {
                return Err(Error::Internal("the fit of a deformable set that has started cannot start again".into()));
            }
        }
        Ok(None)
    }

    /// Makes a deformable set of the Gaussians of the rest phase.
    fn plant(&self, mut first: GaussianTrainer) -> Result<Tracking> {
        if self.config.gaussians.background_every > 0 {
            first.renew_background()?;
        }
        let meanwhile = first.model()?;
        let mut found = Particles::fresh(meanwhile.rows.clone());
        let strong = strong(&found.rows, first.setup(), TAKE);
        let rest_phase = first.targets().rest_phase as u32;
        let keep: Vec<bool> =
            found.rows.iter().zip(strong).map(|(g, strong)| strong && g.phase == rest_phase).collect();
        found.retain(&keep);
        let trainer = DeformableTrainer::with(&self.gpu, first.into_targets(), &self.config, &found)?;
        let targets = trainer.targets();
        let left =
            if targets.contrast_comes_and_goes { tracks_by_contrast(targets, &meanwhile) } else { tracks(targets) };
        let (fit, mut left) = (trainer.tracking()?, left);
        left.reverse();
        Ok(Tracking { trainer, fit, left, meanwhile })
    }

    /// Share that is done, 0 to 1: one half is the sets per phase, the other the tracking.
    pub fn share(&self) -> f64 {
        match &self.stage {
            Stage::Warming(first) => {
                0.5 * f64::from(first.step()) / f64::from(self.config.deformable.warm_iterations.max(1))
            }
            Stage::Tracking(under_way) => {
                let all = under_way.trainer.targets().n_phases.max(1) as f64;
                1.0 - 0.5 * under_way.left.len() as f64 / all
            }
            Stage::Over => 1.0,
        }
    }

    /// Tells whether a set per phase shows most of the vessels.
    pub fn has_set_per_phase(&self) -> bool {
        match &self.stage {
            Stage::Warming(first) => 2 * first.step() >= self.config.deformable.warm_iterations,
            Stage::Tracking(_) => true,
            Stage::Over => false,
        }
    }

    /// A set per phase, as far as the field is known.
    ///
    /// # Errors
    /// As [`GaussianTrainer::model`].
    pub fn field(&self) -> Result<Gaussians> {
        match &self.stage {
            Stage::Warming(first) => first.model(),
            Stage::Tracking(under_way) => Ok(under_way.meanwhile.clone()),
            Stage::Over => Err(Error::Internal("the deformable set was handed over already".into())),
        }
    }
}

/// In which order phases are tracked, each from the two before it: forward and backward from the phase of rest to the
/// middle of the beat.
fn tracks(targets: &Targets) -> Vec<Track> {
    let (n, rest_phase) = (targets.n_phases as u32, targets.rest_phase as u32);
    // Counted from the phase of rest.
    let forward = (1..=n / 2).map(|t| [t, t - 1, t.saturating_sub(2)]);
    let backward = (n / 2 + 1..n).rev().map(|t| [t, (t + 1) % n, if t + 2 < n { t + 2 } else { 0 }]);
    let track = |since_rest: [u32; 3]| {
        let [phase, before, before_that] = since_rest.map(|t| (rest_phase + t) % n);
        Track { phase, before, before_that, images: images_of(targets, phase), known: Vec::new() }
    };
    forward.chain(backward).map(track).collect()
}

/// Images of a phase, which are consecutive.
fn images_of(targets: &Targets, phase: u32) -> Range<u32> {
    let images: Vec<u32> = targets.views_at(phase as usize).map(|(image, _)| image as u32).collect();
    images.first().map_or(0..0, |first| *first..first + images.len() as u32)
}

/// Returns the order in which phases are tracked where contrast comes or goes, each from the two before it: from the phase of rest on,
/// always the neighbour of a tracked phase whose own set, one of `sets`, has the largest mass.
fn tracks_by_contrast(targets: &Targets, sets: &Gaussians) -> Vec<Track> {
    let n = targets.n_phases;
    let shown: Vec<f64> = (0..n).map(|phase| sets.at(phase).map(|g| mass(g, &sets.setup)).sum()).collect();
    let mut known = vec![targets.rest_phase];
    let mut tracks = Vec::new();
    while known.len() < n {
        // Each open neighbour of a tracked phase, with the step towards it.
        let steps = known.iter().flat_map(|before| [(*before, 1), (*before, n - 1)]);
        let open =
            steps.map(|(before, step)| ((before + step) % n, before, step)).filter(|(to, ..)| !known.contains(to));
        let Some((phase, before, step)) = open.max_by(|a, b| shown[a.0].total_cmp(&shown[b.0])) else { break };
        let two_before = (before + n - step) % n;
        let before_that = if known.contains(&two_before) { two_before } else { before };
        let [at, before, before_that] = [phase, before, before_that].map(|phase| phase as u32);
        tracks.push(Track { phase: at, before, before_that, images: images_of(targets, at), known: known.clone() });
        known.push(phase);
    }
    tracks
}

impl DeformableTrainer {
    /// Starts from targets alone, all of [`DeformableStart`] at once.
    ///
    /// # Errors
    /// As [`DeformableStart::new`] and [`DeformableStart::advance`].
    pub fn new(gpu: &Gpu, targets: Targets, config: &Rules) -> Result<DeformableTrainer> {
        let mut start = DeformableStart::new(gpu, targets, config)?;
        loop {
            if let Some(trainer) = start.advance()? {
                return Ok(trainer);
            }
        }
    }
}
