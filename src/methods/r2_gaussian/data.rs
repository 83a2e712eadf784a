//! A dataset as R2-Gaussian sees it: a cube around the isocentre from -1 to 1, whole images in its units, and which
//! images each set of Gaussians is fitted to.

use crate::config::sections::R2;
use crate::error::Result;
use crate::fitting::sets::{Sets, check_finite, check_sizes};
use crate::gaussians::field::{Gaussians, Units};
use crate::gaussians::view::SplatView;
use crate::kernels::layout::{Gaussian, GaussianSetup, R2Gaussian};
use crate::methods::r2_gaussian::parameters::ScaleBounds;
use crate::scan::dataset::Dataset;

/// Maximum line integral of the images, in units of the drawn field, which can hold eight times as much.
const DRAWN_RANGE: f64 = 256.0;

/// Standard deviations at which drawn Gaussians end. Fitted ones are seen in squares that reach three of the longest standard
/// deviations; next to nothing lies beyond.
const DRAWN_CUT: f32 = 4.0;
/// Bounds of drawn scales are a little wider than what scales can be, so that rounding changes none.
const SLACK: f64 = 1e-3;

/// The data in R2-Gaussian's units.
#[derive(Debug, Clone)]
pub struct R2Data {
    /// Half a side of the volume, world units: the unit of length.
    pub half: f64,
    /// Attenuation per world unit of a density of 1.
    pub attenuation: f64,
    /// Side of a pixel at the isocentre, world units.
    pub pixel: f64,
    /// Columns of an image.
    pub width: usize,
    /// Rows of an image.
    pub height: usize,
    /// Cardiac phases.
    pub n_phases: usize,
    /// The view of each image.
    pub views: Vec<SplatView>,
    /// `[image][pixel]`: line integrals.
    pub images: Vec<f32>,
    /// Images of each set.
    pub sets: Sets,
}

impl R2Data {
    /// Brings a dataset into a volume of half a side `half` each way, world units.
    ///
    /// # Errors
    /// [`crate::error::Error::Config`] for images of several sizes, for a pixel that is not a finite number, and for phases that no
    /// image shows.
    pub fn new(dataset: &Dataset, settings: &R2, half: f64) -> Result<R2Data> {
        check_sizes(dataset, "R2-Gaussian")?;
        let attenuation = dataset.vessel_attenuation.filter(|_| settings.normalise).unwrap_or(1.0);
        let units = Units { pixel: half, strongest: half * attenuation };
        let training = dataset.training();
        let mut images = Vec::with_capacity(training.len() * dataset.n_pixels());
        for frame in training {
            check_finite(dataset, frame)?;
            images.extend(frame.integrals.iter().map(|v| (f64::from(*v) / units.strongest) as f32));
        }
        Ok(R2Data {
            half,
            attenuation,
            pixel: dataset.reference_view().rays.anchor[1].length(),
            width: dataset.width,
            height: dataset.height,
            n_phases: dataset.n_phases as usize,
            views: training.iter().map(|f| SplatView::new(&dataset.views[f.view].rays, units)).collect(),
            images,
            sets: Sets::of(dataset, settings.static_data, "r2.static_data")?,
        })
    }

    /// Images of `size` (columns, rows) in the volume of world units, each set of a phase of its own: for tests.
    #[cfg(test)]
    pub(crate) fn of_images(
        [width, height]: [usize; 2],
        views: Vec<SplatView>,
        images: Vec<f32>,
        images_of_set: Vec<Vec<usize>>,
    ) -> R2Data {
        R2Data {
            half: 1.0,
            attenuation: 1.0,
            pixel: 1.0,
            width,
            height,
            n_phases: images_of_set.len(),
            views,
            images,
            sets: Sets::per_phase(images_of_set),
        }
    }

    /// Pixels of an image.
    pub fn n_pixels(&self) -> usize {
        self.width * self.height
    }

    /// Number of sets of Gaussians.
    pub fn n_sets(&self) -> usize {
        self.sets.len()
    }

    /// Returns the attenuation of a drawn density of 1 over that of a stored one. It is so large that pictures, which are sums
    /// of integers, hold the images' maximum line integral many times.
    fn drawn_scale(&self) -> f64 {
        let max = self.images.iter().copied().fold(0f32, f32::max);
        (f64::from(max) * self.half / self.pixel / DRAWN_RANGE).max(1.0)
    }

    /// The field of stored Gaussians after `step` iterations, in the units that Gaussians are drawn and exported in.
    pub fn field(&self, rows: &[R2Gaussian], bounds: ScaleBounds, step: u32) -> Gaussians {
        let (pixels, scale) = (self.half / self.pixel, self.drawn_scale());
        let convert = |g: &R2Gaussian, phase: u32| Gaussian {
            position: (g.centre() * pixels).as_vec3().to_array(),
            log_density: (g.attenuation() / scale).ln() as f32,
            log_scale: g.scales(bounds).to_array().map(|scale| (scale * pixels).ln() as f32),
            phase,
            rotation: g.rotation,
        };
        let of_phases = self.sets.gaussians_of_phases(rows.iter().map(|g| g.set), self.n_phases);
        Gaussians {
            units: Units { pixel: self.pixel, strongest: self.pixel * self.attenuation * scale },
            n_phases: self.n_phases,
            setup: GaussianSetup {
                n_phases: self.n_phases as u32,
                cut: DRAWN_CUT,
                min_scale: (bounds.min * pixels * (1.0 - SLACK)) as f32,
                max_scale: (bounds.max * pixels * (1.0 + SLACK)) as f32,
                ..GaussianSetup::default()
            },
            rows: of_phases.into_iter().map(|(i, phase)| convert(&rows[i], phase)).collect(),
            step,
            is_crowd: true,
            agreement: None,
            intensities: None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn large_line_integrals_fit_the_drawn_field() {
        let bounds = ScaleBounds { min: 0.001, max: 1.0 };
        let gaussian = R2Gaussian { density: 1.0, ..R2Gaussian::default() };
        let density = gaussian.attenuation();
        for (integral, largest_units) in [(2.0f32, 200.0), (30.0, DRAWN_RANGE)] {
            let images = R2Data::of_images([1, 1], Vec::new(), vec![integral], vec![vec![0]]);
            // A hundred pixels to half the volume.
            let field = R2Data { pixel: 0.01, ..images }.field(&[gaussian], bounds, 0);
            assert!((f64::from(integral) / field.units.strongest - largest_units).abs() < 1e-3 * largest_units);
            let drawn = f64::from(field.rows[0].log_density).exp() * field.units.attenuation();
            assert!((drawn / density - 1.0).abs() < 1e-6, "{drawn} for {density}");
        }
    }
}
