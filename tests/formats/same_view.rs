//! Data sets whose frames state their geometry with the noise of sensors.

use nertca_vk::formats::npy;
use nertca_vk::scan::dataset::Dataset;
use serde_json::json;
use std::path::Path;

/// Number of views of a data set of frames at these primary angles, degrees. A pixel is 0.35 mm at the isocentre, so a tenth of it
/// is an angle of 0.04 degrees at 50 mm.
fn views(directory: &Path, angles_deg: &[f64]) -> usize {
    let frames: Vec<_> = angles_deg
        .iter()
        .enumerate()
        .map(|(index, primary_deg)| {
            let image = format!("{index}.npy");
            npy::write(&directory.join(&image), &[48, 64], &vec![0.5; 48 * 64]).unwrap();
            json!({
                "image": image,
                "phase": index % 2,
                "split": "train",
                "geometry": { "primary_deg": primary_deg, "secondary_deg": 0, "sid_mm": 1000, "sod_mm": 700, "pixel_mm": [0.5, 0.5] },
                "intensity": { "kind": "integral" },
            })
        })
        .collect();
    let manifest =
        json!({ "format": "nertca-dataset", "version": 1, "phases": 2, "depth_half_extent_mm": 90, "frames": frames });
    std::fs::write(directory.join("dataset.json"), manifest.to_string()).unwrap();
    Dataset::open(directory).unwrap().views.len()
}

#[test]
fn frames_within_a_tenth_of_a_pixel_are_one_view() {
    let directory = tempfile::tempdir().unwrap();
    let views = |angles_deg: &[f64]| views(directory.path(), angles_deg);
    assert_eq!(views(&[30.0, 30.0 + 1e-9, -20.0, -20.0 - 1e-9]), 2);
    assert_eq!(views(&[30.0, 30.01, -20.0, -19.99]), 2);
    assert_eq!(views(&[30.0, 30.2, -20.0, -19.8]), 4);
}
