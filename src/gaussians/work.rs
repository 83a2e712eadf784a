//! Cost of an iteration of a fit: pairs of a splat and a pixel, operations, bytes.

use crate::error::Result;
use crate::gpu::buffer::Buffer;
use crate::gpu::device::Gpu;
use crate::kernels::layout::{GaussianSetup, Splat};
use serde::{Deserialize, Serialize};

/// Cost of a splat, which depends on how Gaussians are projected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SplatCost {
    /// Operations per pair of a splat and a pixel of its box, forward and backward; an exponential counts as one.
    flop_per_pair: u64,
    /// Bytes of the moments over a splat's pixels that the gradient needs.
    moment_bytes: u64,
}

impl SplatCost {
    /// Cost of Gaussians projected as ellipses: `gaussian_splat`, `gaussian_moments`.
    pub const AFFINE: SplatCost = SplatCost { flop_per_pair: 52, moment_bytes: 32 };
    /// Cost of Gaussians integrated along the ray of each pixel: `r2_chord_splat`, `r2_chord_moments`.
    pub const CHORD: SplatCost = SplatCost { flop_per_pair: 173, moment_bytes: 48 };
}

/// Bytes per pair: a sum read and written, a gradient read.
const BYTES_PER_PAIR: u64 = 12;
/// Bytes per pixel of the images: its sum read and cleared, two bounds and a weight read, a gradient written.
const BYTES_PER_PIXEL: u64 = 24;
/// Bytes per splat: written and read twice, its image as often; its moments, which are written and read, come on top.
const BYTES_PER_SPLAT: u64 = 3 * (size_of::<Splat>() as u64 + 4);

/// Work of one iteration over all images. Parameters, gradients and the optimiser are not counted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GaussianWork {
    /// Splats: one per Gaussian and view; for a deformable set, one per Gaussian, view and phase.
    pub splats: u64,
    /// Pairs of a splat and a pixel of its box.
    pub pairs: u64,
    /// Operations on these pairs, forward and backward, GFLOP.
    pub gflop: f64,
    /// Bytes that stages read and write without regard to caches, MB.
    pub megabytes: f64,
}

/// Pixels of a splat's box inside the image.
fn pixels(splat: &Splat, setup: &GaussianSetup) -> u64 {
    let along = |axis: usize, n: u32| {
        let first = (splat.mean[axis] - splat.half_box[axis]).ceil().max(0.0);
        let last = (splat.mean[axis] + splat.half_box[axis]).floor().min(n as f32 - 1.0);
        // The box of a Gaussian behind the source has a negative size.
        if last >= first { (last - first) as u64 + 1 } else { 0 }
    };
    along(0, setup.width) * along(1, setup.height)
}

impl GaussianWork {
    /// Work of the splats of the last iteration.
    ///
    /// # Errors
    /// Device errors.
    pub fn of(
        gpu: &Gpu,
        setup: &GaussianSetup,
        (splats, image_of_splat): (&Buffer, &Buffer),
        n_splats: u32,
        cost: SplatCost,
    ) -> Result<GaussianWork> {
        let splats: Vec<Splat> = gpu.download(splats, 0, n_splats as usize)?;
        let images: Vec<i32> = gpu.download(image_of_splat, 0, n_splats as usize)?;
        let seen = splats.iter().zip(&images).filter(|(_, image)| **image >= 0);
        let pairs = seen.map(|(splat, _)| pixels(splat, setup)).sum::<u64>();
        let image_pixels = u64::from(setup.n_images) * u64::from(setup.image_stride);
        let splats = u64::from(n_splats);
        let bytes = pairs * BYTES_PER_PAIR
            + image_pixels * BYTES_PER_PIXEL
            + splats * (BYTES_PER_SPLAT + 2 * cost.moment_bytes);
        let gflop = (pairs * cost.flop_per_pair) as f64 * 1e-9;
        Ok(GaussianWork { splats, pairs, gflop, megabytes: bytes as f64 * 1e-6 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_of_a_box_are_counted_one_by_one() {
        let setup = GaussianSetup { width: 7, height: 5, ..GaussianSetup::default() };
        for (mean, half_box) in [
            ([3.2, 1.9], [1.3, 2.0]),
            ([0.0, 0.0], [2.0, 0.4]),
            ([6.4, 4.4], [3.0, 9.0]),
            ([-5.0, 2.0], [2.0, 2.0]),
            ([3.5, 2.5], [0.2, 0.2]),
            ([3.0, 2.0], [-1.0, -1.0]),
        ] {
            let splat = Splat { mean, half_box, ..Splat::default() };
            let within = |x: u32, axis: usize| (x as f32 - mean[axis]).abs() <= half_box[axis];
            let counted = (0..7 * 5).filter(|p| within(p % 7, 0) && within(p / 7, 1)).count() as u64;
            assert_eq!(pixels(&splat, &setup), counted, "{mean:?} {half_box:?}");
        }
    }
}
