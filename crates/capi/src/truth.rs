//! True vessels given by the caller, and scores.

use crate::output::grid_of;
use crate::reconstruction::{nertca_reconstruction, on_reconstruction};
use crate::status::{Failure, Outcome, nertca_status};
use crate::types::{nertca_grid, nertca_scores, nertca_tree, read, write};
use glam::DVec3;
use nertca_vk_vessels::score::eval::Evaluation;
use nertca_vk_vessels::score::trees::TrueLine;
use nertca_vk_vessels::score::volume::TrueVessels;
use std::collections::BTreeMap;

/// Maximum number of points and of branches of a true tree.
const MAX_ELEMENTS: usize = 1 << 24;

/// Sets the true vessel voxels at the phase of `grid`, in place of those set before for that phase. `vessels` has one byte for
/// each point of the grid, left fastest, non-zero inside a vessel; the grid's component is ignored.
/// `nertca_reconstruction_evaluate` then returns scores in 3D. Null `vessels`, with `bytes` 0, remove the phase. The bytes are
/// copied. Callable from any thread.
///
/// @return NERTCA_ERROR_ARGUMENT for a phase that does not exist, a grid of more than 2^26 points, or too few bytes.
///
/// # Safety
/// `grid` must be as long as its `size` says; `vessels` must be readable for `bytes` bytes or null.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_set_true_vessels(
    reconstruction: *mut nertca_reconstruction,
    grid: *const nertca_grid,
    vessels: *const u8,
    bytes: usize,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header requires the same of `grid` as `grid_of` does.
        let (grid, _, phase) = unsafe { grid_of(grid) }?;
        if vessels.is_null() && bytes == 0 {
            return Ok(reconstruction.session.set_true_vessels(phase, None)?);
        }
        if vessels.is_null() {
            return Err(Failure::argument("vessels", "is null"));
        }
        let needed = grid.size.iter().map(|n| *n as usize).product::<usize>();
        if bytes < needed {
            return Err(Failure::argument("bytes", format!("is {bytes} where {needed} are needed")));
        }
        // SAFETY: the pointer is not null, and the header requires `bytes` bytes, which are enough and which nobody changes
        // during the call.
        let inside = unsafe { std::slice::from_raw_parts(vessels, needed) }.iter().map(|v| *v != 0).collect();
        Ok(reconstruction.session.set_true_vessels(phase, Some(TrueVessels { grid, inside }))?)
    })
}

/// Sets the true centrelines and vessel radii, in place of those set before. The arrays have the form that
/// `nertca_reconstruction_tree` fills. They contain one phase or more, among them phase 0, each with the same branches of the
/// same number of points; point i of a branch is the same material point at every phase. `branch_parent` may be null. Zero
/// branches remove the true centrelines. `nertca_reconstruction_evaluate` then finds the vessels as a tree, which takes
/// seconds, and scores it. The arrays are copied. Callable from any thread.
///
/// @return NERTCA_ERROR_ARGUMENT naming what is wrong.
///
/// # Safety
/// `tree` must be as long as its `size` says, and its arrays readable for `branches` and `points` elements.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_set_true_tree(
    reconstruction: *mut nertca_reconstruction,
    tree: *const nertca_tree,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header requires that `tree` is null or as long as its size says.
        let tree = unsafe { read(tree) }?;
        // SAFETY: the header requires arrays as long as the struct says.
        Ok(reconstruction.session.set_true_trees(unsafe { lines(&tree) }?)?)
    })
}

/// Returns the true lines of each phase.
///
/// # Safety
/// The arrays must be readable for as many elements as the struct says.
unsafe fn lines(tree: &nertca_tree) -> Outcome<BTreeMap<u32, Vec<TrueLine>>> {
    for (name, count) in [("branches", tree.branches), ("points", tree.points)] {
        if count > MAX_ELEMENTS {
            return Err(Failure::argument(name, format!("{count} exceeds the maximum, 2^24")));
        }
    }
    // SAFETY: callers of this function guarantee as many elements, which need no alignment.
    let (phases, firsts, counts, points, radii) = unsafe {
        (
            copied("branch_phase", tree.branch_phase.cast_const(), tree.branches)?,
            copied("branch_first", tree.branch_first.cast_const(), tree.branches)?,
            copied("branch_points", tree.branch_points.cast_const(), tree.branches)?,
            copied("points_mm", tree.points_mm.cast_const(), 3 * tree.points)?,
            copied("radius_mm", tree.radius_mm.cast_const(), tree.points)?,
        )
    };
    let mut lines: BTreeMap<u32, Vec<TrueLine>> = BTreeMap::new();
    let mut taken = 0;
    for (branch, phase) in phases.iter().enumerate() {
        let (first, count) = (firsts[branch] as usize, counts[branch] as usize);
        taken += count;
        if first.saturating_add(count) > tree.points || taken > tree.points {
            let problem =
                format!("branch {branch} has points {first} to {first} + {count}, but there are {}", tree.points);
            return Err(Failure::argument("branch_points", format!("{problem}, or branches share points")));
        }
        let range = first..first + count;
        let points_mm = points[3 * range.start..3 * range.end].chunks(3).map(DVec3::from_slice).collect();
        lines.entry(*phase).or_default().push(TrueLine { points_mm, radius_mm: radii[range].to_vec() });
    }
    Ok(lines)
}

/// # Safety
/// `from` must be null or readable for `count` elements.
unsafe fn copied<T: Copy>(name: &str, from: *const T, count: usize) -> Outcome<Vec<T>> {
    if from.is_null() && count > 0 {
        return Err(Failure::argument(name, "is null"));
    }
    // SAFETY: callers of this function guarantee as many elements, which need no alignment.
    Ok((0..count).map(|i| unsafe { from.add(i).read_unaligned() }).collect())
}

/// Scores the frames that were added with `NERTCA_SPLIT_VALIDATION` (at least one is required), and compares the reconstruction
/// with the true vessels where these are known. `threshold_per_mm` is the attenuation from which the dynamic field counts as
/// vessel; 0 selects a fifth of `vessel_attenuation_per_mm`, or of the strongest attenuation of the field where that is unknown. Callable from any
/// thread, also during training. A library of an earlier version does not write fields that it does not know: set them to NaN
/// before the call if the version may be older. Live pictures pass meanwhile.
///
/// @return NERTCA_ERROR_CANCELLED when `nertca_reconstruction_cancel` ended the call.
///
/// # Safety
/// `scores` must be writable, with its size set.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_evaluate(
    reconstruction: *mut nertca_reconstruction,
    threshold_per_mm: f64,
    scores: *mut nertca_scores,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        if !(threshold_per_mm.is_finite() && threshold_per_mm >= 0.0) {
            return Err(Failure::argument(
                "threshold_per_mm",
                format!("{threshold_per_mm} is not a finite attenuation of at least 0"),
            ));
        }
        if scores.is_null() {
            return Err(Failure::argument("scores", "is null"));
        }
        let found = reconstruction.session.evaluate((threshold_per_mm > 0.0).then_some(threshold_per_mm))?;
        // SAFETY: the header requires that `scores` is as long as its size says; it is not null.
        unsafe { write(scores, |size| told(size, &found)) }
    })
}

/// Fills the scores; NaN where nothing is known.
fn told(size: usize, found: &Evaluation) -> nertca_scores {
    let (volume, tree) = (found.volume.as_ref(), found.tree.as_ref());
    let shape = volume.map(|v| v.mean.agreement);
    let line = tree.map(|t| t.mean);
    let or_nan = |value: Option<f64>| value.unwrap_or(f64::NAN);
    nertca_scores {
        size,
        step: found.step,
        images: found.images.len() as u32,
        dice_dynamic: or_nan(found.dice.dynamic),
        dice_total: or_nan(found.dice.total),
        psnr_db: found.psnr,
        ssim: found.ssim,
        threshold_per_mm: found.threshold.dynamic_per_mm,
        volume_phases: volume.map_or(0, |v| v.phases.len() as u32),
        tree_phases: tree.map_or(0, |t| t.phases.len() as u32),
        volume_dice: or_nan(shape.map(|s| s.dice)),
        chamfer_mm: or_nan(shape.and_then(|s| s.chamfer_mm)),
        hausdorff95_mm: or_nan(shape.and_then(|s| s.hausdorff95_mm)),
        true_centreline_found: or_nan(shape.and_then(|s| s.true_centreline_found)),
        our_centreline_true: or_nan(shape.and_then(|s| s.our_centreline_true)),
        cl_dice: or_nan(shape.and_then(|s| s.cl_dice)),
        components: or_nan(shape.map(|s| s.components)),
        true_components: or_nan(shape.map(|s| s.true_components)),
        tree_true_centreline_found: or_nan(line.map(|l| l.true_centreline_found)),
        tree_our_centreline_true: or_nan(line.map(|l| l.our_centreline_true)),
        tree_ours_to_true_mm: or_nan(line.map(|l| l.ours_to_true_mm)),
        tree_components: or_nan(line.map(|l| l.components)),
        radius_error_mm: or_nan(line.and_then(|l| l.radius_error_mm)),
        radius_rmse_mm: or_nan(line.and_then(|l| l.radius_rmse_mm)),
        motion_error_mm: or_nan(line.and_then(|l| l.motion_error_mm)),
    }
}
