//! Lengths of the settings, in pixels, adapted to the images at hand: larger images show the same field, and noise asks for
//! smoother vessels.

use crate::evidence::series::blur;
use crate::methods::dynamic_gaussians::rules::{DeformableRules, GaussianRules};
use crate::raster::Image;
use std::borrow::Borrow;

/// Smaller side, pixels, of the images to which the settings' lengths refer. It is the size of the default phantom, on which the settings
/// were tuned.
const SIDE: f64 = 100.0;
/// Noise, as a share of the strongest change, from which on vessels are smoothed most.
const SMOOTHEST_AT: f64 = 0.1;
/// Factor on the minimum scale from that noise on; with less noise it grows in proportion. Chosen with the minimum scales of
/// docs/tried.md (`min_scale`).
const SMOOTHEST: f64 = 1.5;
/// Upper limit of a minimum scale that noise has raised, as a share of the width of wide vessels.
const SHARE_OF_WIDTH: f64 = 0.27;
/// Change, as a share of the strongest, that wide vessels exceed.
const WIDE_CHANGE: f32 = 0.3;
/// Blur of the images before wide vessels are looked for, pixels.
const WIDE_BLUR: f32 = 0.7;

/// Lengths of a fit, from its images.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lengths {
    /// Pixels of the images per pixel of the settings; lengths and rates of lengths are multiplied by it.
    pub factor: f64,
    /// Additional factor on the minimum scale, from noise.
    pub smoothing: f64,
}

impl Lengths {
    /// Lengths for images whose smaller side has `side` pixels, with vessels of `width` pixels ([`vessel_width`]) and the median
    /// `noise` of their pixels, as a share of the strongest change; `min_scale` is the setting.
    pub fn new(side: usize, width: f64, noise: f32, min_scale: f64) -> Lengths {
        let factor = side as f64 / SIDE;
        let share = f64::from(noise) / SMOOTHEST_AT;
        let wanted = 1.0 + (SMOOTHEST - 1.0) * share.clamp(0.0, 1.0);
        let possible = SHARE_OF_WIDTH * width / (factor * min_scale);
        Lengths { factor, smoothing: wanted.min(possible).max(1.0) }
    }

    /// Settings with lengths in pixels of the images.
    pub fn gaussians(self, settings: &GaussianRules) -> GaussianRules {
        let min_scale = self.smoothing * self.factor * settings.min_scale;
        GaussianRules {
            first_scale: (self.factor * settings.first_scale).max(min_scale),
            min_scale,
            max_scale: (self.factor * settings.max_scale).max(min_scale),
            position_rate: self.factor * settings.position_rate,
            link: self.factor * settings.link,
            ..settings.clone()
        }
    }

    /// Settings with lengths in pixels of the images. Penalties stay: squared lengths grow as the number of pixels does.
    pub fn deformable(self, settings: &DeformableRules) -> DeformableRules {
        DeformableRules {
            node: self.factor * settings.node,
            grid_rate: self.factor * settings.grid_rate,
            own_rate: self.factor * settings.own_rate,
            track_blur: self.factor * settings.track_blur,
            track_rate: self.factor * settings.track_rate,
            ..settings.clone()
        }
    }
}

/// Mean width, pixels, of vessels whose change of the `images` is a large share of the `strongest` change: twice their area
/// over the length of their outline; 0 without any.
pub fn vessel_width(images: impl Iterator<Item = impl Borrow<Image>>, strongest: f32) -> f64 {
    // A line of any direction crosses on average 4 / pi as many edges of pixels as it is long.
    const EDGES_PER_LENGTH: f64 = 4.0 / std::f64::consts::PI;
    let (mut area, mut edges) = (0usize, 0usize);
    for image in images {
        let image = image.borrow();
        let (w, h) = (image.width, image.height);
        let blurred = blur(image, WIDE_BLUR);
        let wide = |x: usize, y: usize| x < w && y < h && blurred.values[y * w + x] > WIDE_CHANGE * strongest;
        for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
            area += usize::from(wide(x, y));
            edges += usize::from(wide(x, y) != wide(x + 1, y)) + usize::from(wide(x, y) != wide(x, y + 1));
        }
    }
    2.0 * EDGES_PER_LENGTH * area as f64 / edges.max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::methods::dynamic_gaussians::targets::test_targets::rules;

    /// A vessel across the whole image, `width` pixels wide across its direction (degrees).
    fn vessel(width: f64, angle_deg: f64) -> Image {
        let (sin, cos) = angle_deg.to_radians().sin_cos();
        let across = |p: usize| (p % 80) as f64 * sin - (p / 80) as f64 * cos - 40.0 * (sin - cos);
        let values = (0..80 * 80).map(|p| if across(p).abs() < 0.5 * width { 0.8 } else { 0.0 }).collect();
        Image { width: 80, height: 80, values }
    }

    #[test]
    fn widths_of_vessels_in_all_directions_are_found() {
        for width in [3.0, 6.0, 12.0] {
            let images: Vec<Image> = (0..12).map(|k| vessel(width, 15.0 * f64::from(k) + 4.0)).collect();
            let found = vessel_width(images.iter(), 0.8);
            // Blur at a level below half the vessel's widens it by half a pixel or so; ends at the border do the rest.
            assert!((found / width - 1.1).abs() < 0.15, "{found} against {width}");
        }
        assert_eq!(vessel_width([Image::zeros(9, 9)].iter(), 1.0), 0.0);
    }

    #[test]
    fn lengths_follow_the_images_and_noise_the_vessels_width() {
        let settings = rules().gaussians;
        let min = |size: usize, width: f64, noise: f32| {
            Lengths::new(size, width, noise, settings.min_scale).gaussians(&settings).min_scale
        };
        assert!((min(100, 5.0, 0.0) - 0.4).abs() < 1e-9 && (min(200, 10.0, 0.0) - 0.8).abs() < 1e-9);
        assert!((min(100, 5.0, 0.2) - 0.6).abs() < 1e-9 && (min(200, 10.0, 0.2) - 1.2).abs() < 1e-9);
        assert!((min(100, 1.4, 0.2) - 0.4).abs() < 1e-9, "thin vessels stay sharp");
        assert!((min(100, 5.0, 0.05) - 0.5).abs() < 1e-6);
    }
}
