//! Several fits to the same images, whose mean is the dynamic field: each fit to noisy or inconsistent images has errors of its own.

use crate::error::{Error, Result};
use crate::fitting::fit::MadeGaussians;
use crate::gaussians::field::DynamicGaussians;
use crate::gpu::device::Gpu;
use crate::methods::dynamic_gaussians::fit::GaussianFit;
use crate::methods::dynamic_gaussians::made::Made;
use crate::methods::dynamic_gaussians::rules::Rules;
use crate::methods::dynamic_gaussians::targets::Targets;

/// Difference of the seeds of one fit and the next.
const NEXT_SEED: u32 = 1000;
/// Factor on the mean attenuation. Fits place a vessel next to each other, so that their mean is broader and fainter than the vessel.
const MEAN_FACTOR: f64 = 4.0 / 3.0;
/// Number of fits to noisy or inconsistent images. The mean of fits to good images is broader than each of them.
const FITS: u32 = 3;
/// Number of views up to which several fits are made where blades hide much.
const FEW_VIEWS: usize = 3;
/// Share of hidden pixels from which on blades hide much.
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
            0 if self.is_noisy() => (FITS, Some("because the images are noisy")),
            0 if self.n_views <= FEW_VIEWS && self.hidden_share() >= HIDDEN => {
                (FITS, Some("because blades hide much of the few views"))
            }
            0 if self.views_adjusted => (FITS, Some("because the views had to be adjusted")),
            0 | 1 => (1, None),
            n => (n, Some("as gaussians.fits says")),
        }
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
    /// Images of the other fits that are left; none for a single fit.
    targets: Option<Targets>,
    config: Rules,
    fits: u32,
    /// Fit that is under way: the run's, one of the others, or the run's again, to report its iterations.
    fit: GaussianFit,
    /// Losses of the run's fit while it is the first of several.
    losses: Vec<f64>,
    /// The run's fit while the others are made.
    own: Option<Made>,
    /// Fields of the other fits that are done.
    others: Vec<DynamicGaussians>,
    /// Findings of these fits that were not taken yet.
    findings: Vec<String>,
    /// Mean of the fields that are done, which is shown meanwhile.
    so_far: Option<DynamicGaussians>,
    was_coarse: bool,
}

impl Repeated {
    /// Begins the number of fits that configuration and data ask for. A fit that was made before is not repeated if it is the run's.
    ///
    /// # Errors
    /// As [`GaussianFit::new`].
    pub(crate) fn new(gpu: &Gpu, targets: Targets, config: &Rules, made: Option<&MadeGaussians>) -> Result<Repeated> {
        let made = made.and_then(|made| Made::of(made, &targets, config));
        let fits = targets.fits(config.fits).0.max(1);
        let for_others = (fits > 1).then(|| targets.clone());
        let fit = match made {
            Some(made) => GaussianFit::Made(Box::new(made)),
            None => GaussianFit::new(gpu, targets, config)?,
        };
        Ok(Repeated { fits, targets: for_others, ..Repeated::once(gpu, config, fit) })
    }

    /// Takes a single fit.
    pub(crate) fn once(gpu: &Gpu, config: &Rules, fit: GaussianFit) -> Repeated {
        Repeated {
            gpu: gpu.clone(),
            targets: None,
            config: config.clone(),
            fits: 1,
            losses: Vec::new(),
            own: None,
            others: Vec::new(),
            findings: Vec::new(),
            so_far: None,
            was_coarse: fit.is_coarse(),
            fit,
        }
    }

    /// Tells whether the field of a fit of `end` iterations is worth more than one that was fitted to fewer frames.
    pub(crate) fn is_presentable(&self, end: u32) -> bool {
        self.so_far.is_some() || self.fits == 1 && self.fit.is_presentable(end)
    }

    /// Tells whether the iterations of the fit that is under way are reported as those of the run.
    fn is_last(&self) -> bool {
        self.others.len() + 1 >= self.fits as usize
    }

    /// Tells whether the run's iterations use coarser images so far.
    pub(crate) fn is_coarse(&self) -> bool {
        if self.is_last() { self.fit.is_coarse() } else { self.was_coarse }
    }

    /// Returns the iterations of the run that are done.
    pub(crate) fn step(&self) -> u32 {
        if self.is_last() { self.fit.step() } else { 0 }
    }

    /// Returns the share done of the preparation before the first iteration of the run; none when that has begun.
    pub(crate) fn preparation(&self) -> Option<f64> {
        let iterated = f64::from(self.fit.step()) / f64::from(self.config.gaussian_iterations().max(1));
        let of_fit = match self.fit.preparation() {
            Some(share) if self.is_last() => share,
            None if self.is_last() => return None,
            Some(share) => 0.5 * share,
            // The run's fit was prepared before; the others need no preparation.
            None if self.own.is_none() => 0.5 + 0.5 * iterated,
            None => iterated,
        };
        let done = self.others.len() + usize::from(self.own.is_some());
        Some((done as f64 + of_fit) / f64::from(self.fits))
    }

    /// Runs some iterations towards `until`; returns the losses of those of the run.
    ///
    /// # Errors
    /// As [`GaussianFit::advance`].
    pub(crate) fn advance(&mut self, until: u32) -> Result<Vec<f64>> {
        if self.is_last() {
            return self.fit.advance(until);
        }
        let end = self.config.gaussian_iterations();
        let losses = self.fit.advance(end)?;
        if self.own.is_none() {
            self.losses.extend(losses);
        }
        if self.fit.step() >= end {
            let findings = self.findings_of_fit();
            self.findings.extend(findings);
            self.fit = self.next()?;
        }
        Ok(Vec::new())
    }

    /// Keeps the fit that is done, and begins the next one.
    fn next(&mut self) -> Result<GaussianFit> {
        let field = self.fit.field()?;
        let own = match self.own.take() {
            Some(own) => {
                self.others.push(field);
                own
            }
            None => Made::done(field, std::mem::take(&mut self.losses)),
        };
        self.so_far = Some(self.mean_with(own.field())?);
        if self.is_last() {
            return Ok(GaussianFit::Made(Box::new(own)));
        }
        let number = self.others.len() as u32 + 1;
        let seed = self.config.seed.wrapping_add(NEXT_SEED * number);
        let (targets, config) = (self.images(number)?, Rules { seed, ..self.config.clone() });
        let fit = GaussianFit::reseeded(&self.gpu, targets, &config, own.field())?;
        self.own = Some(own);
        Ok(fit)
    }

    /// Returns findings of all fits about the data since the last call, for the user.
    pub(crate) fn take_findings(&mut self) -> Vec<String> {
        let last = if self.is_last() { self.findings_of_fit() } else { Vec::new() };
        std::mem::take(&mut self.findings).into_iter().chain(last).collect()
    }

    /// Takes the findings of the fit that is under way, which name it where there are several.
    fn findings_of_fit(&mut self) -> Vec<String> {
        let number = if self.own.is_some() { self.others.len() + 2 } else { 1 };
        let fits = self.fits;
        let named = |finding| if fits > 1 { format!("fit {number} of {fits}: {finding}") } else { finding };
        self.fit.take_findings().into_iter().map(named).collect()
    }

    /// Returns the images of one of the other fits. The last one takes them over.
    fn images(&mut self, number: u32) -> Result<Targets> {
        let images = if number + 1 == self.fits { self.targets.take() } else { self.targets.clone() };
        images.ok_or_else(|| Error::Internal("there are no images for another fit".into()))
    }

    /// Returns the field: the mean of all fits that are done, or the field of the first fit.
    ///
    /// # Errors
    /// As [`GaussianFit::field`].
    pub(crate) fn field(&self) -> Result<DynamicGaussians> {
        self.so_far.as_ref().map_or_else(|| self.fit.field(), |so_far| Ok(so_far.clone()))
    }

    /// Returns the mean of the run's field and those of the other fits that are done.
    fn mean_with(&self, own: &DynamicGaussians) -> Result<DynamicGaussians> {
        mean(&std::iter::once(own).chain(&self.others).cloned().collect::<Vec<_>>())
    }
}

/// Returns the mean of fits; a single one as it is.
fn mean(fields: &[DynamicGaussians]) -> Result<DynamicGaussians> {
    let mean = match fields {
        [field] => Some(field.clone()),
        fields => DynamicGaussians::mean(fields, MEAN_FACTOR),
    };
    mean.ok_or_else(|| Error::Internal("repeated fits to the same images have different forms".into()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::dynamic_gaussians::test_targets::{PHASES, SIDE, targets};

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
