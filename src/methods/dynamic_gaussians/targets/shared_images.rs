//! Images of which many are equal, such as the noise of a view at every phase: each is stored once.

use std::ops::{Index, IndexMut};

/// Values of images, `[image][pixel]`, of which equal ones share their storage.
#[derive(Debug, Clone, PartialEq)]
pub struct SharedImages {
    /// `[slot][pixel]`: the images that differ.
    values: Vec<f32>,
    /// `[image]`: slot of each image.
    slots: Vec<usize>,
    /// Pixels of an image.
    n_pixels: usize,
}

impl SharedImages {
    /// Makes images of `n_pixels` pixels from the `values` of the slots, `[slot][pixel]`, and the slot of each image.
    pub fn new(values: Vec<f32>, slots: Vec<usize>, n_pixels: usize) -> SharedImages {
        SharedImages { values, slots, n_pixels }
    }

    /// Makes images that each have values of their own, `[image][pixel]`.
    pub fn of_each(values: Vec<f32>, n_pixels: usize) -> SharedImages {
        let slots = (0..values.len() / n_pixels.max(1)).collect();
        SharedImages { values, slots, n_pixels }
    }

    /// Returns the pixels of an image.
    pub fn image(&self, image: usize) -> &[f32] {
        &self.values[self.slots[image] * self.n_pixels..][..self.n_pixels]
    }

    /// Returns the slot of each image: images of one slot are equal.
    pub fn slots(&self) -> &[usize] {
        &self.slots
    }

    /// Returns images made of the images of the slots, `[slot][pixel]`, with `n_pixels` pixels each.
    pub fn map(&self, n_pixels: usize, of: impl FnOnce(&[f32]) -> Vec<f32>) -> SharedImages {
        SharedImages { values: of(&self.values), slots: self.slots.clone(), n_pixels }
    }

    /// Returns images of the values that `of` makes of those of these images and of `other` ones, which share slots in the same way.
    pub fn zip(&self, other: &SharedImages, of: impl Fn(f32, f32) -> f32) -> SharedImages {
        let values = self.values.iter().zip(&other.values).map(|(a, b)| of(*a, *b)).collect();
        SharedImages { values, slots: self.slots.clone(), n_pixels: self.n_pixels }
    }

    /// Sets all pixels.
    pub fn fill(&mut self, value: f32) {
        self.values.fill(value);
    }

    /// Returns the median over the pixels of all images; the lower one of two, and 0 without pixels.
    pub fn median(&self) -> f32 {
        let mut uses = vec![0usize; self.values.len() / self.n_pixels.max(1)];
        self.slots.iter().for_each(|slot| uses[*slot] += 1);
        let mut counted: Vec<(f32, usize)> =
            self.values.iter().enumerate().map(|(at, value)| (*value, uses[at / self.n_pixels])).collect();
        counted.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let mut below = (self.slots.len() * self.n_pixels).saturating_sub(1) / 2;
        for (value, n) in counted {
            if below < n {
                return value;
            }
            below -= n;
        }
        0.0
    }
}

impl Index<usize> for SharedImages {
    type Output = f32;

    /// Returns a pixel by its index over all images.
    fn index(&self, at: usize) -> &f32 {
        &self.values[self.slots[at / self.n_pixels] * self.n_pixels + at % self.n_pixels]
    }
}

impl IndexMut<usize> for SharedImages {
    /// Returns a pixel, which all images of its slot share, by its index over all images.
    fn index_mut(&mut self, at: usize) -> &mut f32 {
        &mut self.values[self.slots[at / self.n_pixels] * self.n_pixels + at % self.n_pixels]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::raster::percentile;

    #[test]
    fn pixels_are_those_of_the_slot_of_their_image() {
        let mut shared = SharedImages::new(vec![1.0, 2.0, 3.0, 4.0], vec![1, 0, 1], 2);
        assert_eq!([0, 1, 2, 3, 4, 5].map(|at| shared[at]), [3.0, 4.0, 1.0, 2.0, 3.0, 4.0]);
        assert_eq!((shared.image(1), shared.image(2)), (&[1.0, 2.0][..], &[3.0, 4.0][..]));
        shared[5] = 9.0;
        assert_eq!((shared[1], shared[3]), (9.0, 2.0), "images of one slot are changed together");
    }

    #[test]
    fn a_median_counts_every_image() {
        for slots in [vec![0, 1, 2], vec![0, 0, 0, 1, 2], vec![2, 2, 1, 0, 2, 2], vec![1]] {
            let shared = SharedImages::new(vec![0.5, 7.0, 1.0, 2.0, 3.0, 0.1], slots.clone(), 2);
            let all: Vec<f32> = (0..2 * slots.len()).map(|at| shared[at]).collect();
            assert_eq!(shared.median(), percentile(&all, 0.5), "{slots:?}");
        }
        assert_eq!(SharedImages::new(Vec::new(), Vec::new(), 4).median(), 0.0);
    }
}
