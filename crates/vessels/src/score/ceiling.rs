//! Score of the true vessels on unseen images: no field can be expected to exceed it by much under the same rule.

use crate::error::Result;
use crate::formats::volume::{Volume, VolumeHints};
use crate::formats::volume_files;
use crate::geometry::{ViewRays, world_to_index};
use crate::scan::dataset::{Dataset, Frame};
use crate::scan::truth::{VOLUMES, truth_file};
use crate::score::dice::{BestDice, mean, overlap};
use crate::score::metrics;
use glam::{DAffine3, DVec3};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;

/// Distance between the samples of a volume along a ray, voxels.
const STEP: f64 = 0.5;

/// Dice of the true vessels on unseen images, by the rule for the dynamic field.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TruthDice {
    /// Mean over images with a mask, at the dynamic field's threshold.
    pub dice: f64,
    /// Dice at the best threshold, which is found with the masks.
    pub best: Option<BestDice>,
}

/// Scores the true vessels of a dataset: a pixel counts as vessel where the maximum attenuation along its ray through the
/// volumes exceeds `threshold_per_mm`. Returns `None` where no unseen image has both a mask and a volume of its phase.
/// `proceed` is called before every image; its error ends the work.
///
/// # Errors
/// [`crate::error::Error::Data`] and [`crate::error::Error::Io`] for volumes that cannot be read; errors of `proceed`.
pub fn truth_dice(
    dataset: &Dataset,
    threshold_per_mm: f64,
    mut proceed: impl FnMut() -> Result<()>,
) -> Result<Option<TruthDice>> {
    let mut of_phase: BTreeMap<u32, Vec<&Frame>> = BTreeMap::new();
    for frame in dataset.validation().iter().filter(|frame| frame.mask.is_some()) {
        of_phase.entry(frame.phase).or_default().push(frame);
    }
    let mut seen = Vec::new();
    for (phase, frames) in of_phase {
        let file = truth_file(&dataset.path.join(VOLUMES), phase);
        if !file.is_file() {
            continue;
        }
        let volume = volume_files::read(&file, &VolumeHints::default())?;
        for frame in frames {
            proceed()?;
            let view = &dataset.views[frame.view];
            let maxima = largest_per_mm(&volume, &view.rays, view.size, dataset.depth_range);
            seen.push((dataset.own_frame(frame), maxima));
        }
    }
    let Some(dice) = mean(seen.iter().filter_map(|(frame, maxima)| overlap(frame, maxima, threshold_per_mm))) else {
        return Ok(None);
    };
    let masked = seen.iter().filter_map(|(frame, maxima)| Some((&maxima[..], frame.mask.as_deref()?)));
    let best = metrics::best_dice(&masked.collect::<Vec<_>>(), threshold_per_mm as f32);
    let best = best.map(|(dice, threshold)| BestDice { dice, threshold_per_mm: f64::from(threshold) });
    Ok(Some(TruthDice { dice, best }))
}

/// Maximum attenuation of a volume along each ray of a view, per mm: `size` columns and rows, depths in world units.
fn largest_per_mm(volume: &Volume, rays: &ViewRays, size: [usize; 2], depths: (f64, f64)) -> Vec<f32> {
    let to_index = world_to_index(&volume.index_to_lps);
    let pixel = |index: usize| {
        let (anchor, direction) = rays.pixel((index % size[0]) as f64, (index / size[0]) as f64);
        largest_along(volume, &to_index, (anchor, direction), depths)
    };
    (0..size[0] * size[1]).into_par_iter().map(pixel).collect()
}

/// Maximum attenuation of a volume along one ray, given by an anchor and a direction of unit depth.
fn largest_along(
    volume: &Volume,
    to_index: &DAffine3,
    (anchor, direction): (DVec3, DVec3),
    (near, far): (f64, f64),
) -> f32 {
    let (from, along) = (to_index.transform_point3(anchor), to_index.transform_vector3(direction));
    let last = DVec3::from_array(volume.size.map(|n| n as f64 - 1.0));
    // A ray along an axis divides by zero; the infinite results mean that it is inside or outside along its whole length.
    let (to_low, to_high) = (-from / along, (last - from) / along);
    let enters = to_low.min(to_high).max_element().max(near);
    let leaves = to_low.max(to_high).min_element().min(far);
    if enters.partial_cmp(&leaves) != Some(std::cmp::Ordering::Less) {
        return 0.0;
    }
    let steps = ((leaves - enters) * along.length() / STEP).ceil() as usize;
    let at = |step: usize| from + along * (enters + (leaves - enters) * step as f64 / steps as f64);
    let inside = |step: usize| volume.interpolated(at(step));
    (0..=steps).map(inside).fold(0.0, f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{CArm, Geometry};

    #[test]
    fn rays_find_the_densest_place_on_their_way() {
        // A bar along x (left) of 1 per mm in a grid of 21 mm, with a denser spot.
        const N: usize = 21;
        let mut values = vec![0f32; N * N * N];
        for x in 0..N {
            values[(10 * N + 10) * N + x] = if x == 4 { 3.0 } else { 1.0 };
        }
        let volume = Volume::centred([N, N, N], 1.0, DVec3::ZERO, values);
        let c_arm = |primary_deg: f64| CArm {
            primary_deg,
            secondary_deg: 0.0,
            sid_mm: 1000.0,
            sod_mm: 500.0,
            pixel_mm: [2.0; 2],
            offset_mm: [0.0; 2],
            table_mm: [0.0; 3],
        };
        let seen = |primary_deg: f64| {
            let rays = Geometry::CArm(c_arm(primary_deg)).rays(31, 31).unwrap();
            largest_per_mm(&volume, &rays, [31, 31], (-0.2, 0.2))
        };
        let middle = |image: &[f32]| image[15 * 31..16 * 31].to_vec();
        let front = middle(&seen(0.0));
        assert!(front[..4].iter().all(|v| *v == 0.0) && front[8..23].iter().all(|v| *v > 0.5), "{front:?}");
        let spot = front.iter().copied().fold(0.0, f32::max);
        assert!((2.0..=3.0).contains(&spot), "{spot}");
        // From the side the bar is a point, with the density of its densest spot.
        let side = seen(90.0);
        assert!(side[15 * 31 + 15] > 2.2 && side.iter().filter(|v| **v > 0.5).count() < 12);
        // Depths end at the limits of the dataset.
        let rays = Geometry::CArm(c_arm(90.0)).rays(31, 31).unwrap();
        assert!(largest_per_mm(&volume, &rays, [31, 31], (0.15, 0.2)).iter().all(|v| *v == 0.0));
    }
}
