//! Prior vessels of a run from the files that other programs write.

use crate::error::{Error, Result};
use crate::formats::volume::{Volume, VolumeHints};
use crate::formats::volume_files;
use crate::scan::prior::{MAX_PRIOR_POINTS, VesselPrior};
use glam::DVec3;
use nertca_vk_phantom::tree::Tree;
use nertca_vk_phantom::tree_file::TreeFile;
use std::collections::BTreeMap;
use std::path::Path;

/// Distance between neighbouring points of a prior, mm.
const STEP_MM: f64 = 1.0;
/// Share of a volume's maximum from which on a voxel is vessel.
const VESSEL_SHARE: f32 = 0.5;
/// Endings of the names of tree files.
const TREE_FILES: [&str; 3] = ["json", "vtp", "pvd"];

/// Reads prior vessels: a tree as `phantom --tree` takes it (.json, .vtp, .pvd), or a volume in which vessels are brightest, such as
/// the mask of a segmented CT (.nrrd, .nii, .nii.gz, .mha). Positions are those of the patient on the table, with the isocentre at
/// the origin.
///
/// # Errors
/// [`Error::Data`] naming file and field, [`Error::Io`].
pub fn read(path: &Path) -> Result<VesselPrior> {
    let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    let shapes: Vec<Vec<DVec3>> = if TREE_FILES.contains(&ending.as_str()) {
        TreeFile::read(path)?.stored().map(|tree| points_of(&tree)).collect()
    } else {
        vec![voxels_of(&volume_files::read(path, &VolumeHints::default())?)]
    };
    let most = shapes.iter().map(Vec::len).max().unwrap_or(0);
    if most == 0 {
        return Err(Error::data(path, "vessels", "no vessel is there: no voxel is positive"));
    }
    if most > MAX_PRIOR_POINTS {
        let problem = format!(
            "there are {most} points at a distance of {STEP_MM} mm, more than {MAX_PRIOR_POINTS}: state the vessels alone, for example as \
             the mask of a segmentation"
        );
        return Err(Error::data(path, "vessels", problem));
    }
    Ok(VesselPrior { shapes_mm: shapes.iter().map(|shape| shape.iter().map(|p| p.to_array()).collect()).collect() })
}

/// Points along the branches of a tree, at most [`STEP_MM`] apart.
fn points_of(tree: &Tree) -> Vec<DVec3> {
    let mut points = Vec::new();
    for branch in &tree.branches {
        for ends in branch.points.windows(2) {
            let steps = (ends[0].distance(ends[1]) / STEP_MM).ceil().max(1.0);
            points.extend((0..steps as usize).map(|step| ends[0].lerp(ends[1], step as f64 / steps)));
        }
        points.extend(branch.points.last());
    }
    points
}

/// One point per cube of [`STEP_MM`] that holds a vessel voxel of a volume.
fn voxels_of(volume: &Volume) -> Vec<DVec3> {
    let threshold = VESSEL_SHARE * volume.values.iter().copied().fold(0.0, f32::max);
    let [nx, ny, _] = volume.size;
    let index = |i: usize| DVec3::new((i % nx) as f64, (i / nx % ny) as f64, (i / (nx * ny)) as f64);
    let vessels = volume.values.iter().enumerate().filter(|(_, value)| **value > 0.0 && **value >= threshold);
    let cubes: BTreeMap<[i64; 3], DVec3> = vessels
        .map(|(i, _)| volume.index_to_lps.transform_point3(index(i)))
        .map(|point| ((point / STEP_MM).round().to_array().map(|v| v as i64), point))
        .collect();
    cubes.into_values().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::nrrd;

    #[test]
    fn a_tree_and_its_mask_are_the_same_prior() {
        let directory = tempfile::tempdir().unwrap();
        let (tree, mask) = (directory.path().join("tree.json"), directory.path().join("mask.nrrd"));
        // A branch along the patient's left, in RAS mm.
        let json =
            r#"{"branches":[{"name":"a","first":0,"count":2}],"radius_mm":[1,1],"points_mm":[[[-10,5,2],[-20,5,2]]]}"#;
        std::fs::write(&tree, json).unwrap();
        let along =
            |i: usize| if (10..=20).contains(&(i % 32)) && i / 32 % 32 == 11 && i / 1024 == 18 { 1.0 } else { 0.0 };
        let volume = Volume {
            index_to_lps: glam::DAffine3::from_translation(DVec3::new(0.0, -16.0, -16.0)),
            ..Volume::centred([32; 3], 1.0, DVec3::ZERO, (0..32 * 32 * 32).map(along).collect())
        };
        nrrd::write(&mask, &volume, "mask").unwrap();
        let (of_tree, of_mask) = (read(&tree).unwrap().at(0.0), read(&mask).unwrap().at(0.0));
        assert_eq!(of_tree.len(), 11);
        assert!(of_tree.iter().all(|p| of_mask.iter().any(|q| p.distance(*q) < 1e-9)), "{of_tree:?} {of_mask:?}");
        assert_eq!(of_mask.len(), 11);
    }

    #[test]
    fn an_empty_mask_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        let mask = directory.path().join("mask.nrrd");
        nrrd::write(&mask, &Volume::centred([4; 3], 1.0, DVec3::ZERO, vec![0.0; 64]), "mask").unwrap();
        assert!(read(&mask).unwrap_err().to_string().contains("no vessel"));
    }
}
