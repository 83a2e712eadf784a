//! Chunks: rays of a batch whose samples are handled at once.

use crate::error::{Error, Result};
use crate::gpu::record::{Groups, MAX_GROUPS};
use crate::kernels::layout::Setup;

/// Rays whose samples are handled at once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Chunk {
    /// First ray of the batch.
    pub first_ray: u32,
    /// Number of rays.
    pub n_rays: u32,
}

impl Chunk {
    /// Returns one workgroup per ray.
    pub fn per_ray(self) -> Groups<'static> {
        self.workgroups(1)
    }

    /// Returns the workgroups that take `rays_each` rays each.
    pub fn workgroups(self, rays_each: u32) -> Groups<'static> {
        Groups::Direct([self.n_rays.div_ceil(rays_each), 1, 1])
    }

    /// Tells whether the chunk ends a batch of `n_rays`.
    pub fn is_last(self, n_rays: u32) -> bool {
        self.first_ray + self.n_rays == n_rays
    }

    /// Returns 0 for the first chunk of a batch and 1 for all others, whose sums are added to what the first one wrote.
    pub fn accumulate(self) -> u32 {
        u32::from(self.first_ray > 0)
    }
}

/// Number of live samples that a chunk has room for, in whole tiles.
pub fn chunk_samples(setup: &Setup) -> u32 {
    setup.sample_capacity / 128 * 128
}

/// Number of rays handled at once: their samples fit one chunk even if all are live, and one dispatch can have a workgroup for
/// each.
pub fn chunk_rays(setup: &Setup) -> u32 {
    (chunk_samples(setup) / setup.n_dynamic_samples).clamp(1, MAX_GROUPS)
}

/// Splits a batch into chunks of as many rays as possible such that the `live` samples of each chunk fit into `room`. There are
/// never more chunks than [`chunks`] makes, and few where the hull leaves few live samples.
///
/// # Errors
/// [`Error::Internal`] for a ray with more samples than there is room for.
pub fn packed(live: &[u32], room: u32) -> Result<Vec<Chunk>> {
    let mut chunks = Vec::new();
    let (mut first_ray, mut taken) = (0, 0u64);
    for (ray, samples) in (0u32..).zip(live) {
        if *samples > room {
            return Err(Error::Internal(format!(
                "ray {ray} has {samples} live samples, but a chunk has room for {room}"
            )));
        }
        let n_rays = ray - first_ray;
        if n_rays == MAX_GROUPS || taken + u64::from(*samples) > u64::from(room) {
            chunks.push(Chunk { first_ray, n_rays });
            (first_ray, taken) = (ray, 0);
        }
        taken += u64::from(*samples);
    }
    let n_rays = live.len() as u32 - first_ray;
    if n_rays > 0 {
        chunks.push(Chunk { first_ray, n_rays });
    }
    Ok(chunks)
}

/// Splits a batch into chunks of equal numbers of rays.
pub fn chunks(setup: &Setup, n_rays: u32) -> impl Iterator<Item = Chunk> + use<> {
    let per = chunk_rays(setup).min(n_rays).max(1);
    (0..n_rays.div_ceil(per)).map(move |i| Chunk { first_ray: i * per, n_rays: per.min(n_rays - i * per) })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{STREAM_JITTER, uniform01};

    #[test]
    fn rays_are_packed_as_tightly_as_there_is_room() {
        let in_chunks = |live: &[u32], room| {
            packed(live, room).unwrap().iter().map(|c| (c.first_ray, c.n_rays)).collect::<Vec<_>>()
        };
        assert_eq!(in_chunks(&[], 8), []);
        assert_eq!(in_chunks(&[0; 5], 8), [(0, 5)], "nothing to look at");
        assert_eq!(in_chunks(&[8, 8, 0, 1], 8), [(0, 1), (1, 2), (3, 1)]);
        assert_eq!(in_chunks(&[3, 5, 0, 4, 4, 1], 8), [(0, 3), (3, 2), (5, 1)]);
        let many = vec![0; MAX_GROUPS as usize + 2];
        assert_eq!(in_chunks(&many, 8), [(0, MAX_GROUPS), (MAX_GROUPS, 2)], "a workgroup for each ray");
        assert!(packed(&[1, 9], 8).unwrap_err().to_string().contains("ray 1 has 9 live samples"));
    }

    #[test]
    fn no_chunk_overflows_and_none_is_left_out() {
        for seed in 0..200 {
            let n_samples = 1 + seed % 40;
            let setup =
                Setup { n_dynamic_samples: n_samples, sample_capacity: 128 * (1 + seed % 3) + 12, ..Setup::default() };
            let room = chunk_samples(&setup);
            let live: Vec<u32> = (0..700)
                .map(|ray| (f64::from(n_samples + 1) * uniform01(seed, STREAM_JITTER, 0, ray)) as u32)
                .collect();
            let found = packed(&live, room).unwrap();
            let mut next = 0;
            for Chunk { first_ray, n_rays } in &found {
                assert_eq!(*first_ray, next);
                next += n_rays;
                assert!(live[*first_ray as usize..next as usize].iter().sum::<u32>() <= room);
            }
            assert_eq!(next as usize, live.len());
            assert!(found.len() <= chunks(&setup, live.len() as u32).count());
        }
    }
}
