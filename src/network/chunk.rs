//! Rays whose samples are handled at once.

use crate::gpu::record::{Groups, MOST_GROUPS};
use crate::kernels::layout::Setup;

/// Rays whose samples are handled at once.
#[derive(Debug, Clone, Copy)]
pub struct Chunk {
    /// First ray of the batch.
    pub first_ray: u32,
    /// How many.
    pub n_rays: u32,
}

impl Chunk {
    /// One workgroup per ray.
    pub fn per_ray(self) -> Groups<'static> {
        Groups::Direct([self.n_rays, 1, 1])
    }

    /// Whether it ends a batch of `n_rays`.
    pub fn is_last(self, n_rays: u32) -> bool {
        self.first_ray + self.n_rays == n_rays
    }

    /// 1 for all chunks of a batch but the first: sums add to what that one wrote.
    pub fn accumulate(self) -> u32 {
        u32::from(self.first_ray > 0)
    }
}

/// Rays handled at once: their samples fit one chunk even if all are live, and a dispatch takes a workgroup for each.
pub fn chunk_rays(setup: &Setup) -> u32 {
    (setup.sample_capacity / 128 * 128 / setup.n_dynamic_samples).clamp(1, MOST_GROUPS)
}

/// A batch in chunks.
pub fn chunks(setup: &Setup, n_rays: u32) -> impl Iterator<Item = Chunk> + use<> {
    let per = chunk_rays(setup).min(n_rays).max(1);
    (0..n_rays.div_ceil(per)).map(move |i| Chunk { first_ray: i * per, n_rays: per.min(n_rays - i * per) })
}
