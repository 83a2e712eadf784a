//! Memory that a run of Gaussians takes, from the number and the size of its images.

use crate::evidence::series::Series;
use crate::fitting::fit::MemoryEstimate;
use crate::scan::dataset::Dataset;

/// Memory of the program, its pipelines and small images, bytes; measured with images of 100 x 100 pixels on a CPU driver.
const BASE: u64 = 150 << 20;
/// Sets of images on the host while all pixels are fitted: the targets, their upper bounds, and the images of the field.
const HOST_SETS: u64 = 3;
/// Sets of images on the host while the targets are made: the images without wide motion, their changes, and the three sets of the targets.
const HOST_SETS_OF_PLAN: u64 = 5;
/// Sets of the images of a view on the host while its background is renewed: what the field leaves, the background, and its bounds.
const HOST_SETS_OF_A_VIEW: u64 = 4;
/// Sets of bounds on the device.
const DEVICE_BOUNDS: u64 = 2;
/// Sets of weights, images of the field and their gradient on the device, of no more images than a buffer holds.
const DEVICE_PARTS: u64 = 3;

/// Numbers that the memory of a run follows from.
struct Sizes {
    /// Bytes of all images of the dataset, with their masks.
    dataset: u64,
    /// Bytes of the fitted images as f32.
    set: u64,
    /// Views of the fitted images.
    views: u64,
    /// Maximum size of a buffer of the device, bytes.
    max_buffer: u64,
}

impl Sizes {
    fn estimate(&self) -> MemoryEstimate {
        let Sizes { dataset, set, views, max_buffer } = *self;
        let of_view = HOST_SETS_OF_A_VIEW * set / views.max(1);
        let fit = HOST_SETS * set + of_view;
        let device_bytes = DEVICE_BOUNDS * set + DEVICE_PARTS * set.min(max_buffer);
        MemoryEstimate {
            host_bytes: BASE + dataset + fit.max(HOST_SETS_OF_PLAN * set),
            device_bytes,
            together_bytes: BASE + dataset + (fit + device_bytes).max(HOST_SETS_OF_PLAN * set),
        }
    }
}

/// Estimates the memory of a run on a device whose buffers have at most `max_buffer` bytes.
pub(super) fn estimate(dataset: &Dataset, max_buffer: u64) -> MemoryEstimate {
    let pixels = dataset.n_pixels() as u64;
    let bytes = |n_images: usize| n_images as u64 * pixels * size_of::<f32>() as u64;
    let masks = dataset.frames.iter().filter(|frame| frame.mask.is_some()).count() as u64 * pixels;
    let views = Series::views(dataset);
    let fitted = dataset.training().iter().filter(|frame| views.contains(&frame.view)).count();
    let sizes = Sizes {
        dataset: bytes(dataset.frames.len()) + masks,
        set: bytes(fitted),
        views: views.len() as u64,
        max_buffer,
    };
    sizes.estimate()
}

#[cfg(test)]
mod tests {
    use super::*;

    const MIB: u64 = 1 << 20;

    #[test]
    fn memory_follows_from_the_images() {
        let sizes = Sizes { dataset: 500 * MIB, set: 320 * MIB, views: 4, max_buffer: 128 * MIB };
        let estimate = sizes.estimate();
        assert_eq!(estimate.device_bytes, (2 * 320 + 3 * 128) * MIB);
        assert_eq!(estimate.host_bytes, (150 + 500 + 5 * 320) * MIB, "the plan takes most");
        assert_eq!(estimate.together_bytes, (150 + 500 + 4 * 320 + 1024) * MIB, "the fit takes most");
        let of_gpu = Sizes { max_buffer: 4096 * MIB, views: 1, ..sizes }.estimate();
        assert_eq!(of_gpu.device_bytes, 5 * 320 * MIB);
        assert_eq!(of_gpu.host_bytes, (150 + 500 + 7 * 320) * MIB, "all images are those of one view");
    }
}
