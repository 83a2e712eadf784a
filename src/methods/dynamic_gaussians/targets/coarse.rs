//! Targets of large images at a coarser resolution: vessels are found and followed there, at a small part of the cost, and only the last
//! iterations need all pixels.

use crate::gaussians::field::Units;
use crate::methods::dynamic_gaussians::targets::lengths::Lengths;
use crate::methods::dynamic_gaussians::targets::{PossibleVessel, Targets, weight_of_noise};

/// Minimum smaller side of a coarse image, pixels: a little more than the images to which the settings refer.
const COARSE_SIDE: usize = 128;

/// Pixels of an image that become one pixel of a coarser image.
struct Bins {
    factor: usize,
    /// Columns of the image.
    width: usize,
    /// Columns and rows of the coarser image.
    size: (usize, usize),
}

impl Bins {
    /// Indices, in the image, of the pixels of a coarse pixel.
    fn pixels(&self, column: usize, row: usize) -> impl Iterator<Item = usize> {
        let (factor, width) = (self.factor, self.width);
        let first = row * factor * width + column * factor;
        (0..factor).flat_map(move |j| (0..factor).map(move |i| first + j * width + i))
    }

    /// Coarse images of `values`, `[image][pixel]`: `mean` of the pixels of each coarse pixel.
    fn of(&self, values: &[f32], n_pixels: usize, mean: impl Fn(&mut dyn Iterator<Item = f32>) -> f32) -> Vec<f32> {
        let (width, height) = self.size;
        let mut coarse = Vec::with_capacity(values.len() / (self.factor * self.factor));
        for image in values.chunks(n_pixels) {
            for row in 0..height {
                coarse.extend((0..width).map(|column| mean(&mut self.pixels(column, row).map(|pixel| image[pixel]))));
            }
        }
        coarse
    }
}

impl Targets {
    /// Returns the factor by which a fit begins on coarser images; 1 where images are small.
    pub fn coarse_factor(&self) -> usize {
        (self.width.min(self.height) / COARSE_SIDE).max(1)
    }

    /// Returns the targets with each `factor` x `factor` pixels in one; rows and columns beyond the last whole pixel are left out.
    /// `noise_scale` is that of [`Targets::new`]. A pixel is hidden if one of its parts is.
    pub fn coarser(&self, factor: usize, noise_scale: f64) -> Targets {
        let (width, height) = (self.width / factor, self.height / factor);
        let bins = Bins { factor, width: self.width, size: (width, height) };
        let n = (factor * factor) as f32;
        let mean = |values: &[f32]| bins.of(values, self.n_pixels(), |values| values.sum::<f32>() / n);
        // Noise of neighbouring pixels is taken as independent.
        let root = |values: &mut dyn Iterator<Item = f32>| values.map(|s| s * s).sum::<f32>().sqrt() / n;
        let noise = self.noise.map(width * height, |noise| bins.of(noise, self.n_pixels(), root));
        let min = |values: &mut dyn Iterator<Item = f32>| values.fold(f32::INFINITY, f32::min);
        let shown = self.weight.map(width * height, |weight| bins.of(weight, self.n_pixels(), min));
        let weight = |shown: f32, noise: f32| match shown > 0.0 {
            true => weight_of_noise(noise.into(), noise_scale),
            false => 0.0,
        };
        let scale = factor as f64;
        let place = |p: &PossibleVessel| PossibleVessel { position: p.position / scale, ..*p };
        Targets {
            units: Units { pixel: self.units.pixel * scale, ..self.units },
            width,
            height,
            views: self.views.iter().map(|view| view.coarser(scale)).collect(),
            left_out: self.left_out.clone(),
            image_of: self.image_of.clone(),
            contrast: self.contrast.clone(),
            images: mean(&self.images),
            max: self.max.as_deref().map(mean),
            low: mean(&self.low),
            high: mean(&self.high),
            weight: shown.zip(&noise, weight),
            noise,
            lengths: Lengths { factor: self.lengths.factor / scale, ..self.lengths },
            places: self.places.iter().map(|places| places.iter().map(place).collect()).collect(),
            cell: self.cell / scale,
            ..*self
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::sections::LeftOut;
    use crate::gaussians::view::SplatView;
    use crate::geometry::{CArm, Geometry};
    use crate::methods::dynamic_gaussians::targets::shared_images::SharedImages;
    use glam::DVec3;

    const WIDTH: usize = 7;
    const HEIGHT: usize = 4;

    fn targets() -> Targets {
        let geometry = CArm {
            primary_deg: 20.0,
            secondary_deg: -10.0,
            sid_mm: 1000.0,
            sod_mm: 700.0,
            pixel_mm: [1.0, 1.2],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        };
        let units = Units { pixel: 0.01, strongest: 0.2 };
        let rays = Geometry::CArm(geometry).rays(WIDTH, HEIGHT).unwrap();
        let images: Vec<f32> = (0..2 * WIDTH * HEIGHT).map(|p| p as f32).collect();
        let mut weight = vec![0.5; images.len()];
        weight[WIDTH + 2] = 0.0;
        Targets {
            units,
            width: WIDTH,
            height: HEIGHT,
            n_phases: 2,
            n_views: 1,
            views: vec![SplatView { after_phase: 0.25, ..SplatView::new(&rays, units) }; 2],
            image_of: vec![Some(0), Some(1)],
            n_images: 2,
            max: Some(images.iter().map(|v| v + 3.0).collect()),
            low: images.iter().map(|v| v - 1.0).collect(),
            high: images.iter().map(|v| v + 2.0).collect(),
            noise: SharedImages::of_each(vec![0.1; images.len()], WIDTH * HEIGHT),
            contrast: vec![1.0, 0.9],
            images,
            weight: SharedImages::of_each(weight, WIDTH * HEIGHT),
            lengths: Lengths { factor: 4.0, smoothing: 1.2 },
            rest_phase: 1,
            contrast_comes_and_goes: false,
            views_adjusted: false,
            left_out: LeftOut::default(),
            places: vec![
                vec![PossibleVessel { position: DVec3::new(4.0, 6.0, -8.0), evidence: 9.0, far_from_prior: 0.0 }],
                Vec::new(),
            ],
            cell: 3.0,
        }
    }

    #[test]
    fn coarse_pixels_are_means_and_lengths_shrink() {
        let (fine, coarse) = (targets(), targets().coarser(2, 0.05));
        assert_eq!((coarse.width, coarse.height, coarse.n_images), (3, 2, 2), "the last column is left out");
        // Pixels 0, 1, 7 and 8 have the mean 4; pixels of the second image are 28 higher, of the second row 14.
        assert_eq!(coarse.images, [4.0, 6.0, 8.0, 18.0, 20.0, 22.0, 32.0, 34.0, 36.0, 46.0, 48.0, 50.0]);
        assert_eq!((coarse.low[1], coarse.high[1], coarse.max.as_ref().unwrap()[1]), (5.0, 8.0, 9.0));
        assert!((0..12).all(|p| (coarse.noise[p] - 0.05).abs() < 1e-7), "half the noise");
        let hidden: Vec<usize> = (0..12).filter(|p| coarse.weight[*p] == 0.0).collect();
        assert_eq!(hidden, [1], "one of its pixels is hidden");
        assert!((coarse.weight[0] - 0.5f32.sqrt()).abs() < 1e-6, "the weight of its own noise");
        assert_eq!((coarse.units.pixel, coarse.units.strongest, coarse.cell), (0.02, 0.2, 1.5));
        assert_eq!(coarse.lengths, Lengths { factor: 2.0, smoothing: 1.2 });
        assert_eq!((coarse.rest_phase, &coarse.image_of, &coarse.contrast), (1, &fine.image_of, &fine.contrast));
        let at = coarse.places[0][0].position;
        assert_eq!(at, DVec3::new(2.0, 3.0, -4.0));
        let [(_, u, v), (_, wide_u, wide_v)] = [fine.views[0].project(2.0 * at), coarse.views[0].project(at)];
        assert!((2.0 * wide_u + 0.5 - u).abs() < 1e-9 && (2.0 * wide_v + 0.5 - v).abs() < 1e-9);
        assert_eq!(coarse.views[0].after_phase, 0.25);
    }

    #[test]
    fn only_large_images_are_begun_on_coarser_ones() {
        let of = |width, height| Targets { width, height, ..targets() }.coarse_factor();
        assert_eq!([of(100, 100), of(255, 400), of(256, 256), of(512, 512), of(1024, 700)], [1, 1, 2, 4, 5]);
    }
}
