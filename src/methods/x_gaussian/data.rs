//! A dataset as X-Gaussian sees it: images from 0 to 1, views in mm, and which images each set of Gaussians is fitted
//! to.

use crate::config::sections::X;
use crate::error::{Error, Result};
use crate::fitting::sets::{Sets, check_finite, check_sizes};
use crate::gaussians::field::{Gaussians, Units};
use crate::gaussians::view::SplatView;
use crate::geometry::MM_PER_UNIT;
use crate::kernels::layout::{Gaussian, GaussianSetup};
use crate::methods::x_gaussian::state::XState;
use crate::scan::dataset::Dataset;
use glam::DVec3;

/// Extent of the scene, in units of the largest distance of a source from the sources' mean.
const EXTENTS: f64 = 1.1;
/// Standard deviations at which Gaussians end where their sum is drawn or sampled.
const DRAWN_CUT: f32 = 4.0;
/// Bounds of drawn scales, pixels, that no fit meets.
const DRAWN_SCALES: [f32; 2] = [1e-6, 1e6];

/// The data in X-Gaussian's units: lengths are mm.
#[derive(Debug, Clone)]
pub struct XData {
    /// Half a side of the volume, mm.
    pub half_mm: f64,
    /// Unit of the rates of positions and of the bounds of scales, mm.
    pub extent_mm: f64,
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
    /// `[image][pixel]`: from 0 to 1.
    pub images: Vec<f32>,
    /// Share of the images' pixels that were beyond what they are clamped to.
    pub clamped: f64,
    /// Images of each set.
    pub sets: Sets,
}

/// Scales an image from its minimum, which becomes 0, to its maximum, which becomes 1; a constant image becomes 0.
fn normalised(image: &[f32]) -> Vec<f32> {
    let (low, high) = image.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
    if high <= low {
        return vec![0.0; image.len()];
    }
    image.iter().map(|v| (v - low) / (high - low)).collect()
}

/// 1.1 times the largest distance of a source from the mean of the sources.
fn extent_of(views: &[SplatView]) -> f64 {
    let mut sources: Vec<DVec3> = Vec::new();
    for view in views {
        if !sources.contains(&view.source) {
            sources.push(view.source);
        }
    }
    let mean = sources.iter().sum::<DVec3>() / sources.len().max(1) as f64;
    EXTENTS * sources.iter().map(|source| source.distance(mean)).fold(0.0, f64::max)
}

impl XData {
    /// Brings a dataset into a volume of half a side `half` each way, world units.
    ///
    /// # Errors
    /// [`Error::Config`] for images of several sizes, and for a pixel that is not a number; [`Error::Unmet`] where all sources are at one
    /// place and no extent is stated.
    pub fn new(dataset: &Dataset, settings: &X, half: f64) -> Result<XData> {
        check_sizes(dataset, "X-Gaussian")?;
        let unit = dataset.vessel_attenuation.unwrap_or(1.0);
        let max = if settings.clamp > 0.0 { settings.clamp } else { f64::INFINITY };
        let training = dataset.training();
        let (mut images, mut beyond) = (Vec::with_capacity(training.len() * dataset.n_pixels()), 0);
        for frame in training {
            check_finite(dataset, frame)?;
            let in_units = frame.integrals.iter().map(|v| f64::from(*v) / unit);
            beyond += in_units.clone().filter(|v| *v > max).count();
            let low = if settings.clamp > 0.0 { 0.0 } else { f64::NEG_INFINITY };
            let clamped: Vec<f32> = in_units.map(|v| v.clamp(low, max) as f32).collect();
            images.extend(normalised(&clamped));
        }
        let units = Units { pixel: 1.0 / MM_PER_UNIT, strongest: 1.0 };
        let views: Vec<_> = training.iter().map(|f| SplatView::new(&dataset.views[f.view].rays, units)).collect();
        let extent_mm = if settings.extent_mm > 0.0 { settings.extent_mm } else { extent_of(&views) };
        if extent_mm <= 0.0 {
            let problem = "all views have the same source position, so that the scene has no extent: X-Gaussian needs views from \
                           several positions";
            return Err(Error::unmet("dataset", dataset.path.display(), problem));
        }
        Ok(XData {
            half_mm: half * MM_PER_UNIT,
            extent_mm,
            pixel: dataset.reference_view().rays.anchor[1].length(),
            width: dataset.width,
            height: dataset.height,
            n_phases: dataset.n_phases as usize,
            clamped: beyond as f64 / images.len().max(1) as f64,
            views,
            images,
            sets: Sets::of(dataset, settings.static_data, "x.static_data")?,
        })
    }

    /// Pixels of an image.
    pub fn n_pixels(&self) -> usize {
        self.width * self.height
    }

    /// Number of sets of Gaussians.
    pub fn n_sets(&self) -> usize {
        self.sets.len()
    }

    /// The field of stored Gaussians after `step` iterations, in the units that Gaussians are drawn and exported in:
    /// attenuation is the sum of opacities, per world unit.
    pub fn field(&self, state: &XState, step: u32) -> Gaussians {
        let pixels = 1.0 / (self.pixel * MM_PER_UNIT);
        let convert = |row: usize, phase: u32| {
            let g = &state.rows[row];
            let drawn = Gaussian {
                position: g.position.map(|x| (f64::from(x) * pixels) as f32),
                log_density: g.log_opacity() as f32,
                log_scale: g.log_scale.map(|log| (f64::from(log) + pixels.ln()) as f32),
                phase,
                rotation: g.rotation,
            };
            (drawn, g.intensity)
        };
        let of_phases = self.sets.gaussians_of_phases(state.sets.iter().copied(), self.n_phases);
        let (rows, intensities) = of_phases.into_iter().map(|(row, phase)| convert(row, phase)).unzip();
        Gaussians {
            units: Units { pixel: self.pixel, strongest: self.pixel },
            n_phases: self.n_phases,
            setup: GaussianSetup {
                n_phases: self.n_phases as u32,
                cut: DRAWN_CUT,
                min_scale: DRAWN_SCALES[0],
                max_scale: DRAWN_SCALES[1],
                ..GaussianSetup::default()
            },
            rows,
            step,
            is_crowd: true,
            agreement: None,
            intensities: Some(intensities),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn images_go_from_nothing_to_one_and_even_ones_are_nothing() {
        assert_eq!(normalised(&[0.5, 1.5, 1.0]), [0.0, 1.0, 0.5]);
        assert_eq!(normalised(&[0.7; 4]), [0.0; 4]);
    }

    #[test]
    fn the_extent_is_that_of_the_sources_each_counted_once() {
        let at = |x: f64| SplatView {
            rows: [DVec3::X; 3],
            offsets: [0.0; 3],
            direction: [DVec3::X; 3],
            source: DVec3::new(x, 0.0, 0.0),
            after_phase: 0.0,
        };
        let views = [at(0.0), at(0.0), at(0.0), at(300.0)];
        assert!((extent_of(&views) - 165.0).abs() < 1e-12);
        assert_eq!(extent_of(&views[..3]), 0.0);
    }
}
