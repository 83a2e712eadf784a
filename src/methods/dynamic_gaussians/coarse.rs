//! Targets of large images at a coarser resolution: vessels are found and followed there, at a small part of the cost, and only the last
//! iterations need all pixels.

use crate::gaussians::field::Units;
use crate::methods::dynamic_gaussians::lengths::Lengths;
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
        let noise = bins.of(&self.noise, self.n_pixels(), |values| values.map(|s| s * s).sum::<f32>().sqrt() / n);
        let shown = bins.of(&self.weight, self.n_pixels(), |values| values.fold(f32::INFINITY, f32::min));
        let weight = |(shown, noise): (&f32, &f32)| match *shown > 0.0 {
            true => weight_of_noise((*noise).into(), noise_scale),
            false => 0.0,
        };
        let scale = factor as f64;
        let place = |p: &PossibleVessel| PossibleVessel { position: p.position / scale, ..*p };
        Targets {
            units: Units { pixel: self.units.pixel * scale, ..self.units },
            width,
            height,
            views: self.views.iter().map(|view| view.coarser(scale)).collect(),
            image_of: self.image_of.clone(),
            images: mean(&self.images),
            max: mean(&self.max),
            low: mean(&self.low),
            high: mean(&self.high),
            weight: shown.iter().zip(&noise).map(weight).collect(),
            noise,
            lengths: Lengths { factor: self.lengths.factor / scale, ..self.lengths },
            places: self.places.iter().map(|places| places.iter().map(place).collect()).collect(),
            cell: self.cell / scale,
            ..*self
        }
    }
}
