//! Vessels as trees of centrelines with radii.

use crate::reconstruction::{Reconstruction, nertca_reconstruction, on_reconstruction};
use crate::status::{Failure, NERTCA_ERROR_BUFFER, NERTCA_ERROR_NOT_READY, Outcome, nertca_status};
use crate::types::{nertca_lesion, nertca_tree, read, write};
use nertca_vk_vessels::trees::lesions::{Lesion, lesions};
use nertca_vk_vessels::trees::tree::{BeatTree, Branch, RadiiFrom};
use std::sync::PoisonError;

/// Finds the vessels at all phases as trees of centrelines with radii. If all arrays of `tree` are null, the call searches and
/// returns the sizes of the arrays. Called again with arrays, it copies the trees found before, whatever training has done since.
/// The search takes seconds; live pictures pass, and `nertca_reconstruction_cancel` ends it.
///
/// Branches are listed phase by phase, each after its parent. Where `followed` is 1, all phases have the same branches with the
/// same number of points, and point i of a branch is the same material point at every phase; otherwise each phase has its own
/// branches. Motion along a vessel is not observed in projections: it is determined by smoothness alone. Callable from any
/// thread, also during training.
///
/// @return NERTCA_ERROR_CANCELLED when `nertca_reconstruction_cancel` ended the search; NERTCA_ERROR_NOT_READY before anything
/// was trained or loaded; NERTCA_ERROR_ARGUMENT for a negative threshold or length, for a dynamic field without vessels above the
/// threshold, and where only some arrays are given; NERTCA_ERROR_BUFFER when the arrays are too short: the counts are then the
/// required ones.
///
/// # Safety
/// `tree` must be as long as its `size` says, and its arrays null or writable for `branches` and `points` elements.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_tree(
    reconstruction: *mut nertca_reconstruction,
    tree: *mut nertca_tree,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        // SAFETY: the header requires that `tree` is null or as long as its size says.
        let asked = unsafe { read(tree) }?;
        let copies = wants_copies(&asked)?;
        let mut kept = reconstruction.tree.lock().unwrap_or_else(PoisonError::into_inner);
        if !copies {
            *kept = None;
        }
        let found = match kept.take() {
            Some(found) => found,
            None => find(reconstruction, &asked)?,
        };
        let flat = FlatTree::of(&found);
        let told = nertca_tree {
            threshold_per_mm: found.threshold_per_mm,
            followed: u32::from(found.reference_phase.is_some()),
            radii_from_images: u32::from(found.radii_from == RadiiFrom::Images),
            branches: flat.branch_phase.len(),
            points: flat.radius_mm.len(),
            ..asked
        };
        *kept = Some(found);
        // SAFETY: the header requires a struct of at least `tree->size` bytes that may be written.
        unsafe { write(tree, |size| nertca_tree { size, ..told }) }?;
        if !copies {
            return Ok(());
        }
        if asked.branches < told.branches || asked.points < told.points {
            let needed = format!("arrays for {} branches and {} points are needed", told.branches, told.points);
            return Err(Failure::new(NERTCA_ERROR_BUFFER, needed));
        }
        // SAFETY: no array is null, as was checked, and the header requires as many elements as were compared above.
        unsafe {
            copy(&flat.branch_phase, asked.branch_phase);
            copy(&flat.branch_parent, asked.branch_parent);
            copy(&flat.branch_first, asked.branch_first);
            copy(&flat.branch_points, asked.branch_points);
            copy(&flat.points_mm, asked.points_mm);
            copy(&flat.radius_mm, asked.radius_mm);
        }
        let optional = [
            (&flat.doubt_mm, asked.doubt_mm),
            (&flat.doubt_with_motion_mm, asked.doubt_with_motion_mm),
            (&flat.existence, asked.existence),
            (&flat.branch_gap_mm, asked.branch_gap_mm),
        ];
        for (values, array) in optional.into_iter().filter(|(_, array)| !array.is_null()) {
            // SAFETY: the array is not null, and the header requires as many elements as were compared above.
            unsafe { copy(values, array) };
        }
        Ok(())
    })
}

/// Returns a stenosis, from 0, of the vessels that `nertca_reconstruction_tree` found last; `count` receives the number of all stenoses,
/// phase by phase. A null `lesion` asks for the number alone. A vessel is judged if it is wider than the field's resolution, except near its
/// ends; stenoses of less than 30 % are not listed. Where points are followed, a point has one radius, so that phases differ only as far as
/// lengths along the vessel change. Callable from any thread, also during training.
///
/// @return NERTCA_ERROR_NOT_READY before `nertca_reconstruction_tree` has found vessels; NERTCA_ERROR_ARGUMENT for an `index` beyond the
/// last stenosis, and where both pointers are null.
///
/// # Safety
/// `lesion` must be null or writable, with its size set; `count` must be null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn nertca_reconstruction_lesion(
    reconstruction: *mut nertca_reconstruction,
    index: usize,
    lesion: *mut nertca_lesion,
    count: *mut usize,
) -> nertca_status {
    on_reconstruction(reconstruction, |reconstruction| {
        if lesion.is_null() && count.is_null() {
            return Err(Failure::argument("lesion", "is null, and count as well"));
        }
        let kept = reconstruction.tree.lock().unwrap_or_else(PoisonError::into_inner);
        let nothing = "no vessels were found yet: call nertca_reconstruction_tree first";
        let found = kept.as_ref().ok_or_else(|| Failure::new(NERTCA_ERROR_NOT_READY, nothing))?;
        let all = lesions_of(found);
        if !count.is_null() {
            // SAFETY: `count` is not null, and the header requires that it can be written.
            unsafe { count.write_unaligned(all.len()) };
        }
        if lesion.is_null() {
            return Ok(());
        }
        let beyond = || Failure::argument("index", format!("{index} is beyond the last of {} stenoses", all.len()));
        let chosen = *all.get(index).ok_or_else(beyond)?;
        // SAFETY: the header requires a struct of at least `lesion->size` bytes that may be written.
        unsafe { write(lesion, |size| nertca_lesion { size, ..chosen }) }
    })
}

/// Returns the stenoses of all phases; branches are counted over all phases.
fn lesions_of(found: &BeatTree) -> Vec<nertca_lesion> {
    let mut all = Vec::new();
    let mut first = 0;
    for tree in &found.phases {
        let row = |lesion: Lesion| nertca_lesion {
            size: size_of::<nertca_lesion>(),
            phase: tree.phase,
            branch: (first + lesion.branch) as u32,
            point: lesion.point as u32,
            from_root_mm: lesion.from_root_mm,
            length_mm: lesion.length_mm,
            min_diameter_mm: lesion.min_diameter_mm,
            reference_diameter_mm: lesion.reference_diameter_mm,
        };
        all.extend(lesions(tree, found.measurement()).into_iter().map(row));
        first += tree.branches.len();
    }
    all
}

/// Tells whether the caller passed arrays; either all or none of them must be given.
fn wants_copies(asked: &nertca_tree) -> Outcome<bool> {
    let missing = [
        ("branch_phase", asked.branch_phase.is_null()),
        ("branch_parent", asked.branch_parent.is_null()),
        ("branch_first", asked.branch_first.is_null()),
        ("branch_points", asked.branch_points.is_null()),
        ("points_mm", asked.points_mm.is_null()),
        ("radius_mm", asked.radius_mm.is_null()),
    ];
    let optional = [asked.doubt_mm, asked.doubt_with_motion_mm, asked.existence, asked.branch_gap_mm];
    if missing.iter().all(|(_, null)| *null) && optional.iter().all(|array| array.is_null()) {
        return Ok(false);
    }
    match missing.iter().find(|(_, null)| *null) {
        Some((name, _)) => Err(Failure::argument(name, "is null although other arrays are not")),
        None => Ok(true),
    }
}

fn find(reconstruction: &Reconstruction, asked: &nertca_tree) -> Outcome<BeatTree> {
    let given = |value: f64| (value != 0.0).then_some(value);
    Ok(reconstruction.session.trees(given(asked.threshold_per_mm), given(asked.least_branch_mm))?)
}

/// # Safety
/// `to` must be writable for as many elements as `from` has.
unsafe fn copy<T: Copy>(from: &[T], to: *mut T) {
    for (i, value) in from.iter().enumerate() {
        // SAFETY: callers of this function guarantee as many elements, which need no alignment.
        unsafe { to.add(i).write_unaligned(*value) };
    }
}

/// Trees of all phases, concatenated, with one array for each quantity.
#[derive(Default)]
struct FlatTree {
    branch_phase: Vec<u32>,
    branch_parent: Vec<i32>,
    branch_first: Vec<u32>,
    branch_points: Vec<u32>,
    points_mm: Vec<f64>,
    radius_mm: Vec<f64>,
    doubt_mm: Vec<f64>,
    doubt_with_motion_mm: Vec<f64>,
    existence: Vec<f64>,
    branch_gap_mm: Vec<f64>,
}

impl FlatTree {
    fn of(found: &BeatTree) -> FlatTree {
        let mut flat = FlatTree::default();
        for tree in &found.phases {
            let first = flat.branch_phase.len();
            for branch @ Branch { parent, points_mm, radius_mm, .. } in &tree.branches {
                flat.branch_phase.push(tree.phase);
                flat.branch_parent.push(parent.map_or(-1, |parent| (first + parent) as i32));
                flat.branch_gap_mm.push(branch.gap_mm);
                flat.branch_first.push(flat.radius_mm.len() as u32);
                flat.branch_points.push(points_mm.len() as u32);
                flat.points_mm.extend(points_mm.iter().flat_map(|point| point.to_array()));
                flat.radius_mm.extend(radius_mm);
                for point in 0..points_mm.len() {
                    let doubt = branch.doubt.get(point);
                    flat.doubt_mm.push(doubt.map_or(f64::NAN, |doubt| doubt.across_mm));
                    flat.doubt_with_motion_mm.push(doubt.and_then(|doubt| doubt.with_motion_mm).unwrap_or(f64::NAN));
                    flat.existence.push(doubt.map_or(f64::NAN, |doubt| doubt.existence));
                }
            }
        }
        flat
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use nertca_vk_vessels::trees::tree::PhaseTree;

    #[test]
    fn branches_of_all_phases_follow_each_other_with_their_gaps() {
        let branch = |parent: Option<usize>, points: usize, gap_mm: f64| Branch {
            parent,
            points_mm: vec![DVec3::ONE; points],
            radius_mm: vec![0.5; points],
            agreement: Vec::new(),
            doubt: Vec::new(),
            gap_mm,
        };
        let tree = |phase: u32, gap_mm: f64| PhaseTree {
            phase,
            branches: vec![branch(None, 3, 0.0), branch(Some(0), 2, gap_mm)],
        };
        let beat = BeatTree {
            reference_phase: None,
            threshold_per_mm: 0.02,
            resolution_mm: 1.0,
            spacing_mm: 0.5,
            vessel_per_mm: None,
            radii_from: RadiiFrom::Field,
            views: Vec::new(),
            phases: vec![tree(0, 4.5), tree(1, 2.0)],
            measured_mm: Vec::new(),
        };
        let flat = FlatTree::of(&beat);
        assert_eq!(flat.branch_gap_mm, [0.0, 4.5, 0.0, 2.0]);
        assert_eq!(flat.branch_phase, [0, 0, 1, 1]);
        assert_eq!(flat.branch_parent, [-1, 0, -1, 2]);
        assert_eq!((flat.branch_first, flat.branch_points), (vec![0, 3, 5, 8], vec![3, 2, 3, 2]));
        assert_eq!((flat.points_mm.len(), flat.radius_mm.len()), (30, 10));
    }
}
