//! A fit that was made before its run began, while views were adjusted: a run with the same images, geometry and settings does not repeat
//! it.

use crate::fingerprint::Fingerprint;
use crate::gaussians::field::GaussianField;
use crate::methods::dynamic_gaussians::rules::Rules;
use crate::methods::dynamic_gaussians::targets::Targets;

/// A fit of Gaussians that was done before its run begins.
#[derive(Debug, Clone)]
pub struct MadeGaussians {
    /// The field after all iterations.
    pub gaussians: GaussianField,
    /// Loss of each iteration.
    pub losses: Vec<f64>,
    /// Findings about the data, for the user.
    pub findings: Vec<String>,
    /// Fingerprint of the data and the settings of the fit.
    pub fingerprint: String,
}

/// A fit that is done, whose losses are still to be reported.
pub(crate) struct Made {
    fit: MadeGaussians,
    step: u32,
}

impl Made {
    /// Takes over a fit if it is one of these targets and settings, and if no state between its first and last iteration is scored. A
    /// checkpoint that is saved meanwhile holds the field after all iterations; a run that is resumed there repeats the fit.
    pub(crate) fn of(made: &MadeGaussians, targets: &Targets, config: &Rules) -> Option<Made> {
        let end = config.gaussian_iterations();
        let every = config.train.validate_every;
        let whole = made.losses.len() == end as usize && (every == 0 || every >= end);
        (whole && made.fingerprint == fingerprint(targets, config)).then(|| Made { fit: made.clone(), step: 0 })
    }

    /// Takes a fit that is done.
    pub(crate) fn done(gaussians: GaussianField, losses: Vec<f64>) -> Made {
        let fit = MadeGaussians { gaussians, losses, findings: Vec::new(), fingerprint: String::new() };
        Made { fit, step: 0 }
    }

    /// Returns the iterations whose losses were reported.
    pub(crate) fn step(&self) -> u32 {
        self.step
    }

    /// Returns the losses of the iterations up to `until`.
    pub(crate) fn advance(&mut self, until: u32) -> Vec<f64> {
        let first = self.step as usize;
        let end = (until as usize).clamp(first, self.fit.losses.len());
        self.step = end as u32;
        self.fit.losses[first..end].to_vec()
    }

    /// Returns findings about the data since the last call, for the user.
    pub(crate) fn take_findings(&mut self) -> Vec<String> {
        std::mem::take(&mut self.fit.findings)
    }

    /// Returns the field after all iterations.
    pub(crate) fn field(&self) -> &GaussianField {
        &self.fit.gaussians
    }
}

/// Returns the fingerprint of all that decides a fit that has not begun.
pub(crate) fn fingerprint(targets: &Targets, config: &Rules) -> String {
    let mut fingerprint = Fingerprint::default();
    let images = [&targets.images, &targets.low, &targets.high, &targets.contrast];
    images.into_iter().flatten().for_each(|v| fingerprint.word(v.to_bits()));
    for image in (0..targets.n_images).flat_map(|image| [targets.weight.image(image), targets.noise.image(image)]) {
        image.iter().for_each(|v| fingerprint.word(v.to_bits()));
    }
    for view in &targets.views {
        fingerprint.bytes(format!("{view:?}").as_bytes());
    }
    for place in targets.places.iter().flatten() {
        let numbers = place.position.to_array().into_iter().chain([place.evidence, place.far_from_prior]);
        numbers.for_each(|v| fingerprint.bytes(&v.to_bits().to_le_bytes()));
    }
    let rest = (targets.units, targets.width, &targets.image_of, targets.lengths, targets.rest_phase, targets.cell);
    fingerprint.bytes(format!("{rest:?} {} {:?} {:?}", config.seed, config.gaussians, config.deformable).as_bytes());
    fingerprint.hex()
}
