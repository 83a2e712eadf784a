//! Photon noise of phantom images.

use crate::random::{STREAM_PHOTON, normal, uniform01};

/// Minimum count of a pixel, so that its logarithm exists.
const MIN_COUNTS: f64 = 0.5;
/// Expected count above which a normal distribution replaces the Poisson distribution.
const MANY: f64 = 200.0;

/// Number of photons of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Photons {
    /// Photons per pixel of the unattenuated beam, before the patient.
    Unattenuated(f64),
    /// Photons per pixel at the detector, behind the patient, averaged over each image.
    Detector(f64),
}

impl Photons {
    /// Returns a dose that is larger by a factor.
    pub fn scaled(self, factor: f64) -> Photons {
        match self {
            Photons::Unattenuated(photons) => Photons::Unattenuated(factor * photons),
            Photons::Detector(photons) => Photons::Detector(factor * photons),
        }
    }

    /// Photons per pixel of the unattenuated beam, for an image of line integrals.
    pub fn unattenuated(self, image: &[f32]) -> f64 {
        match self {
            Photons::Unattenuated(photons) => photons,
            Photons::Detector(photons) => {
                let transmitted = image.iter().map(|v| (-f64::from(*v)).exp()).sum::<f64>() / image.len() as f64;
                photons / transmitted
            }
        }
    }
}

/// Adds photon counting noise to line integrals. Each image has its own `stream`.
pub fn add_noise(image: &mut [f32], photons: Photons, seed: u32, stream: u32) {
    let photons = photons.unattenuated(image);
    for (pixel, value) in image.iter_mut().enumerate() {
        let expected = photons * (-f64::from(*value)).exp();
        let counts = if expected > MANY {
            (expected + expected.sqrt() * normal(seed, STREAM_PHOTON, stream, pixel as u32)).round()
        } else {
            poisson(expected, seed, stream, pixel as u32)
        };
        *value = -(counts.max(MIN_COUNTS) / photons).ln() as f32;
    }
}

/// Poisson-distributed number by Knuth's product method; `expected` is at most [`MANY`].
fn poisson(expected: f64, seed: u32, stream: u32, pixel: u32) -> f64 {
    let mut log_product = 0.0;
    let mut count = 0u32;
    loop {
        log_product += uniform01(seed ^ count.wrapping_mul(0x9e37_79b9), STREAM_PHOTON, stream, pixel).max(1e-9).ln();
        if log_product < -expected {
            return f64::from(count);
        }
        count += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_has_the_variance_of_its_counts() {
        for (photons, integral) in [(1e6f64, 2.0f32), (500.0, 3.0)] {
            let mut image = vec![integral; 20_000];
            add_noise(&mut image, Photons::Unattenuated(photons), 1, 0);
            let mean = image.iter().map(|v| f64::from(*v)).sum::<f64>() / 20_000.0;
            let var = image.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / 20_000.0;
            let expected = photons * f64::from(-integral).exp();
            let relative = var * expected;
            assert!((0.9..1.25).contains(&relative), "{photons}: {relative}");
        }
    }

    #[test]
    fn the_detector_counts_what_it_was_asked_for() {
        let image = [0.0, 1.0, 2.0, 7.0];
        let open = Photons::Detector(1000.0).unattenuated(&image);
        let mean = image.iter().map(|v| open * f64::from(-*v).exp()).sum::<f64>() / 4.0;
        assert!((mean - 1000.0).abs() < 1e-9, "{mean}");
    }
}
