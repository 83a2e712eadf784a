//! Several fits to the same images, whose mean is the dynamic field: each fit to noisy or inconsistent images has errors of its own.

mod mean;

use crate::config::sections::Rule;
use crate::error::{Error, Result};
use crate::gaussians::field::GaussianField;
use crate::gpu::device::Gpu;
use crate::methods::dynamic_gaussians::deformable::Earlier;
use crate::methods::dynamic_gaussians::fit::{GaussianFit, Position};
use crate::methods::dynamic_gaussians::made::{Made, MadeGaussians};
use crate::methods::dynamic_gaussians::rules::Rules;
use crate::methods::dynamic_gaussians::setup;
use crate::methods::dynamic_gaussians::targets::Targets;

/// Difference of the seeds of one fit and the next.
const NEXT_SEED: u32 = 1000;
/// Factor on the mean attenuation. Fits place a vessel next to each other, so that their mean is broader and fainter than the vessel.
/// Tried with three views and 2e4 photons.
const MEAN_FACTOR: f64 = 4.0 / 3.0;
/// Number of fits to noisy or inconsistent images. The mean of fits to good images is broader than each of them. Figures are in
/// docs/tried.md, repeated fits.
const FITS: u32 = 3;
/// Number of views up to which several fits are made where blades hide much. With four views, the mean is no better (docs/tried.md,
/// repeated fits).
const FEW_VIEWS: usize = 3;
/// Share of hidden pixels from which on blades hide much. Blades that hide a quarter of the vessels hide this share of the pixels or
/// more; with blades that hide a tenth, several fits gain nothing.
const HIDDEN: f64 = 0.3;
/// Number of fits to two views, which leave alternatives: places that few fits find are often false crossings.
const FITS_TO_TWO_VIEWS: u32 = 5;

impl Targets {
    /// Returns the number of fits where `asked` leaves it open (0), and the reason for more than one.
    pub(crate) fn fits(&self, asked: u32) -> (u32, Option<&'static str>) {
        match asked {
            0 if self.n_views == 2 => (
                FITS_TO_TWO_VIEWS,
                Some("because two views leave alternatives, and places that few fits find are often false"),
            ),
            0 if self.is_noisy() && self.left_out.keeps(Rule::FitsInNoise) => {
                (FITS, Some("because the images are noisy"))
            }
            0 if self.blades_hide_much() && self.left_out.keeps(Rule::FitsBehindBlades) => {
                (FITS, Some("because blades hide much of the few views"))
            }
            0 if self.views_adjusted => (FITS, Some("because the views had to be adjusted")),
            0 | 1 => (1, None),
            n => (n, Some("as gaussians.fits says")),
        }
    }

    /// Tells whether blades hide so much of few views that parts of the vessels are seen by one view alone.
    fn blades_hide_much(&self) -> bool {
        self.n_views <= FEW_VIEWS && self.hidden_share() >= HIDDEN
    }

    /// Returns the share of the pixels of all images that blades hide.
    fn hidden_share(&self) -> f64 {
        let hidden = |image: usize| self.weight.image(image).iter().filter(|weight| **weight == 0.0).count();
        let all = self.n_images * self.n_pixels();
        (0..self.n_images).map(hidden).sum::<usize>() as f64 / all.max(1) as f64
    }
}

/// Fits of a run, one after the other. The first has the run's seed, and its iterations are those of the run. Where there are others, they
/// take their motion from it, and its iterations are reported when they are done.
pub(crate) struct Repeated {
    gpu: Gpu,
    config: Rules,
    /// Number of all fits.
    fits: u32,
    /// Fit that is under way.
    fit: GaussianFit,
    stage: Stage,
    /// Whether the first fit begins on coarser images.
    begins_coarse: bool,
}

/// Fit that is under way, with the results of those before it.
enum Stage {
    /// The run's fit: the only one, or its iterations again, to report them, with the mean of all fits.
    Run { mean: Option<GaussianField> },
    /// The first of several fits.
    First { images: Box<Targets>, losses: Vec<f64> },
    /// One of the other fits, with the images for those after it, and the mean of those before it.
    Other { images: Option<Box<Targets>>, first: Box<Made>, others: Vec<GaussianField>, mean: GaussianField },
}

impl Repeated {
    /// Begins the number of fits that configuration and data ask for. A fit that was made before is not repeated if it is the run's. With an
    /// earlier field, there is a single fit.
    ///
    /// # Errors
    /// As [`GaussianFit::new`].
    pub(crate) fn new(
        gpu: &Gpu,
        targets: Targets,
        config: &Rules,
        earlier: Option<&GaussianField>,
        made: Option<&MadeGaussians>,
    ) -> Result<Repeated> {
        let step = setup::carried_step(&config.gaussians);
        let fits = if earlier.is_some() { 1 } else { targets.fits(config.fits).0.max(1) };
        let stage = match fits {
            1 => Stage::Run { mean: None },
            _ => Stage::First { images: Box::new(targets.clone()), losses: Vec::new() },
        };
        let fit = match made.and_then(|made| Made::of(made, &targets, config)) {
            Some(made) => GaussianFit::Made(Box::new(made)),
            None => {
                let earlier = earlier.and_then(|earlier| earlier.moving());
                let earlier = earlier.map(|field| Earlier { field, step, reseeds: false });
                GaussianFit::new(gpu, targets, config, earlier)?
            }
        };
        let begins_coarse = fit.position(config.gaussian_iterations()).is_coarse;
        Ok(Repeated { gpu: gpu.clone(), config: config.clone(), fits, fit, stage, begins_coarse })
    }

    /// Returns the position of the run.
    pub(crate) fn position(&self) -> Position {
        let end = self.config.gaussian_iterations();
        let fit = self.fit.position(end);
        let iterated = f64::from(fit.step) / f64::from(end.max(1));
        let (done, is_presentable) = match &self.stage {
            Stage::Run { mean } => {
                return Position { is_presentable: mean.is_some() || fit.is_presentable, ..fit };
            }
            Stage::First { .. } => (fit.preparation.map_or(0.5 + 0.5 * iterated, |share| 0.5 * share), false),
            // The run's fit was prepared before; the others need no preparation.
            Stage::Other { others, .. } => {
                ((others.len() + 1) as f64 + fit.preparation.map_or(iterated, |share| 0.5 * share), true)
            }
        };
        let preparation = Some(done / f64::from(self.fits));
        Position { step: 0, preparation, is_coarse: self.begins_coarse, is_presentable }
    }

    /// Runs some iterations towards `until`; returns the losses of those of the run, and findings about the data, for the user.
    ///
    /// # Errors
    /// As [`GaussianFit::advance`].
    pub(crate) fn advance(&mut self, until: u32) -> Result<(Vec<f64>, Vec<String>)> {
        let end = self.config.gaussian_iterations();
        let (number, until) = match &self.stage {
            Stage::Run { .. } => (1, until),
            Stage::First { .. } => (1, end),
            Stage::Other { others, .. } => (others.len() + 2, end),
        };
        let mut losses = self.fit.advance(until)?;
        match &mut self.stage {
            Stage::Run { .. } => return Ok((losses, self.findings_of(number))),
            Stage::First { losses: all, .. } => all.append(&mut losses),
            Stage::Other { .. } => {}
        }
        if self.fit.position(end).step < end {
            return Ok(Default::default());
        }
        let findings = self.findings_of(number);
        self.begin_next()?;
        Ok((Vec::new(), findings))
    }

    /// Takes the findings of the fit that is under way, which name it where there are several.
    fn findings_of(&mut self, number: usize) -> Vec<String> {
        let fits = self.fits;
        let named = |finding| if fits > 1 { format!("fit {number} of {fits}: {finding}") } else { finding };
        self.fit.take_findings().into_iter().map(named).collect()
    }

    /// Keeps the fit that is done, and begins the next one: another fit, or the run's again.
    fn begin_next(&mut self) -> Result<()> {
        let field = self.fit.field()?;
        let (images, first, others) = match std::mem::replace(&mut self.stage, Stage::Run { mean: None }) {
            Stage::Run { .. } => return Ok(()),
            Stage::First { images, losses } => (Some(images), Box::new(Made::done(field, losses)), Vec::new()),
            Stage::Other { images, first, mut others, .. } => {
                others.push(field);
                (images, first, others)
            }
        };
        let mean = mean(&std::iter::once(first.field()).chain(&others).cloned().collect::<Vec<_>>())?;
        let Some(images) = images else {
            (self.fit, self.stage) = (GaussianFit::Made(first), Stage::Run { mean: Some(mean) });
            return Ok(());
        };
        let number = others.len() as u32 + 1;
        let seed = self.config.seed.wrapping_add(NEXT_SEED * number);
        let left = (number + 1 < self.fits).then(|| images.clone());
        let earlier = first.field().moving().map(|field| Earlier { field, step: 0, reseeds: true });
        self.fit = GaussianFit::new(&self.gpu, *images, &Rules { seed, ..self.config.clone() }, earlier)?;
        self.stage = Stage::Other { images: left, first, others, mean };
        Ok(())
    }

    /// Returns the field: the mean of all fits that are done, or the field of the first fit.
    ///
    /// # Errors
    /// As [`GaussianFit::field`].
    pub(crate) fn field(&self) -> Result<GaussianField> {
        match &self.stage {
            Stage::Run { mean: Some(mean) } | Stage::Other { mean, .. } => Ok(mean.clone()),
            Stage::Run { mean: None } | Stage::First { .. } => self.fit.field(),
        }
    }
}

/// Returns the mean of fits; a single one as it is.
fn mean(fields: &[GaussianField]) -> Result<GaussianField> {
    let mean = match fields {
        [field] => Some(field.clone()),
        fields => GaussianField::mean(fields, MEAN_FACTOR),
    };
    mean.ok_or_else(|| Error::Internal("repeated fits to the same images have different forms".into()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::dynamic_gaussians::targets::test_targets::{PHASES, SIDE, targets};

    #[test]
    fn few_views_noise_and_blades_ask_for_several_fits() {
        // Views, noise, columns that are hidden in each image, whether the views were adjusted, expected fits.
        for (n_views, noise, hidden, adjusted, expected) in [
            (2, 0.01, 0, false, FITS_TO_TWO_VIEWS),
            (3, 0.01, 0, false, 1),
            (4, 0.2, 0, false, FITS),
            (3, 0.01, SIDE / 5, false, 1),
            (3, 0.01, SIDE / 2, false, FITS),
            (4, 0.01, SIDE / 2, false, 1),
            (4, 0.01, 0, true, FITS),
        ] {
            let mut targets = targets(&vec![0.0; n_views * PHASES * SIDE * SIDE], n_views);
            targets.noise.fill(noise);
            targets.views_adjusted = adjusted;
            // Calibration finds contrasts as well.
            targets.contrast[0] = 0.9;
            let pixels = (0..targets.n_images * SIDE * SIDE).filter(|pixel| pixel % SIDE < hidden);
            pixels.for_each(|pixel| targets.weight[pixel] = 0.0);
            let case = format!("{n_views} views, noise {noise}, {hidden} columns hidden, adjusted {adjusted}");
            let (fits, reason) = targets.fits(0);
            assert_eq!((fits, reason.is_some()), (expected, expected > 1), "{case}");
            assert_eq!(targets.fits(1), (1, None), "a stated number of fits is kept: {case}");
        }
    }
}
