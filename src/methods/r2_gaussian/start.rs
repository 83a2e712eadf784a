//! Start of a fit: at voxels that a filtered back-projection shows, or anywhere in the volume.

use crate::config::R2Start;
use crate::config::sections::R2;
use crate::fitting::sets::seed_of_set;
use crate::gaussians::spacing::spacings;
use crate::kernels::layout::R2Gaussian;
use crate::methods::r2_gaussian::data::R2Data;
use crate::methods::r2_gaussian::fdk::back_projection;
use crate::methods::r2_gaussian::parameters::{ScaleBounds, round};
use crate::random::{STREAM_JITTER, STREAM_PLACE, permute, uniform01};
use glam::DVec3;

/// Density of a Gaussian at the start, as a share of the back-projection there, as in the public code.
const DENSITY_SHARE: f64 = 0.15;
/// Minimum density that can be stored and fitted.
const MIN_DENSITY: f64 = 1e-9;

/// First Gaussians of all sets, and notes about them for the user.
pub fn first_rows(data: &R2Data, settings: &R2, seed: u32) -> (Vec<R2Gaussian>, Vec<String>) {
    let (mut rows, mut notes) = (Vec::new(), Vec::new());
    for set in 0..data.n_sets() {
        let (places, note) = places(data, settings, seed, set);
        notes.extend(note);
        rows.extend(gaussians(&places, ScaleBounds::of(settings), set as u32));
    }
    (rows, notes)
}

/// Centres and densities of a set, and the reason if they are not those that were asked for.
fn places(data: &R2Data, settings: &R2, seed: u32, set: usize) -> (Vec<(DVec3, f64)>, Option<String>) {
    let count = settings.count as usize;
    if settings.init == R2Start::Random {
        return (anywhere(count, seed_of_set(seed, set)), None);
    }
    let side = settings.voxels as usize;
    let volume = back_projection(data, set, side);
    let candidates: Vec<usize> = (0..volume.len()).filter(|k| f64::from(volume[*k]) > settings.candidate).collect();
    if candidates.len() < count {
        let name = data.sets.name(set);
        let note = format!(
            "the back-projection of {name} is above {} at {} voxels, and {count} Gaussians are to begin there: they begin \
             anywhere; a lower r2.n_points or a larger r2.voxels lets them begin there",
            settings.candidate,
            candidates.len()
        );
        return (anywhere(count, seed_of_set(seed, set)), Some(note));
    }
    let voxel = 2.0 / side as f64;
    let drawn = (0..count).map(|i| {
        let n = candidates.len() as u32;
        let k = candidates[permute(i as u32, n, seed_of_set(seed, set), 0, STREAM_PLACE) as usize];
        let index = DVec3::new((k % side) as f64, (k / side % side) as f64, (k / side / side) as f64);
        // The reference code takes the voxel's corner instead of its centre.
        (voxel * index - 1.0, DENSITY_SHARE * f64::from(volume[k]))
    });
    (drawn.collect(), None)
}

/// Points uniform in the volume, with densities from 0 to 1.
fn anywhere(count: usize, seed: u32) -> Vec<(DVec3, f64)> {
    let value = |i: usize, k: u32| uniform01(seed, STREAM_JITTER, i as u32, k);
    (0..count).map(|i| (DVec3::from_array([0, 1, 2].map(|k| 2.0 * value(i, k) - 1.0)), value(i, 3))).collect()
}

/// Round Gaussians as wide as the distance to their neighbours.
fn gaussians(places: &[(DVec3, f64)], bounds: ScaleBounds, set: u32) -> Vec<R2Gaussian> {
    let points: Vec<DVec3> = places.iter().map(|(x, _)| *x).collect();
    let spacings = spacings(&points);
    let pairs = places.iter().zip(spacings);
    pairs.map(|((x, density), scale)| round(*x, density.max(MIN_DENSITY), scale, bounds, set)).collect()
}
