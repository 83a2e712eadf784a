//! The authors' layout, compared with files written by numpy according to their loader
//! (`tests/python/make_nerfca_golden.py`): exact line integrals of a few balls on a detector that is wider than high.

use glam::DVec3;
use nertca_vk::formats::npy;
use nertca_vk::geometry::ViewRays;
use nertca_vk::scan::dataset::{Dataset, Layout};
use nertca_vk::scan::writer::convert;
use serde::Deserialize;
use std::path::{Path, PathBuf};

fn golden() -> PathBuf {
    crate::root::root().join("tests/golden/nerfca")
}

fn read(path: &Path) -> npy::Array {
    npy::read(path, 1 << 20).unwrap()
}

/// Centre and radius in world units, attenuation per world unit.
#[derive(Deserialize)]
struct Ball(DVec3, f64, f64);

impl Ball {
    fn integral(&self, rays: &ViewRays, column: usize, row: usize) -> f64 {
        let direction = rays.pixel(column as f64, row as f64).1.normalize();
        let away = self.0 - rays.source();
        let across2 = away.length_squared() - away.dot(direction).powi(2);
        self.2 * 2.0 * (self.1.powi(2) - across2).max(0.0).sqrt()
    }
}

#[derive(Deserialize)]
struct Balls {
    still: Vec<Ball>,
    /// Balls of the vessel, one per phase.
    vessel: Vec<Ball>,
}

#[test]
fn pictures_are_read_the_right_way_round() {
    let dataset = Dataset::open(&golden()).unwrap();
    let balls: Balls = serde_json::from_slice(&std::fs::read(golden().join("balls.json")).unwrap()).unwrap();
    assert_eq!((dataset.layout, dataset.width, dataset.height), (Layout::Nerfca, 14, 10));
    assert_eq!((dataset.n_phases, dataset.training().len(), dataset.validation().len()), (2, 2, 2));
    for frame in &dataset.frames {
        let rays = &dataset.views[frame.view].rays;
        let vessel = &balls.vessel[frame.phase as usize];
        for pixel in 0..dataset.n_pixels() {
            let (column, row) = (pixel % dataset.width, pixel / dataset.width);
            let through = vessel.integral(rays, column, row);
            let want = through + balls.still.iter().map(|ball| ball.integral(rays, column, row)).sum::<f64>();
            let got = f64::from(frame.integrals[pixel]);
            assert!((got - want).abs() < 2e-6, "{}: column {column}, row {row}: {got}, not {want}", frame.name);
            assert_eq!(frame.mask.as_ref().unwrap()[pixel], through > 0.0, "{}: {column}, {row}", frame.name);
        }
    }
}

#[test]
fn what_is_written_is_what_the_authors_write() {
    let dir = tempfile::tempdir().unwrap();
    let dataset = Dataset::open(&golden()).unwrap();
    convert(&dataset, Layout::Nerfca, dir.path()).unwrap();
    for frame in &dataset.frames {
        let kind = if frame.name.contains("angles=50") { "test-view0" } else { "train-view1" };
        let name = format!("{kind}-phase{:02}", frame.phase);
        for end in [".npy", "-mask.npy"] {
            let got = read(&dir.path().join(format!("{name}{end}")));
            let want = read(&golden().join(format!("{}{end}", frame.name)));
            assert_eq!(got.shape, want.shape, "{name}{end}");
            for (got, want) in got.values.iter().zip(&want.values) {
                assert!((got - want).abs() < 2e-6, "{name}{end}: {got}, not {want}");
            }
        }
    }
}

/// A copy of the golden dataset that can be changed.
fn copied() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(golden()).unwrap() {
        let file = entry.unwrap().path();
        std::fs::copy(&file, dir.path().join(file.file_name().unwrap())).unwrap();
    }
    dir
}

#[test]
fn arrays_of_another_shape_are_refused() {
    let dir = copied();
    let image = dir.path().join("image-hrt=0-resp=0-angles=-30.0-25.0.npy");
    let values = read(&image).values;
    for same in [&[140][..], &[1, 10, 14], &[10, 14, 1]] {
        npy::write(&image, same, &values).unwrap();
        Dataset::open(dir.path()).unwrap();
    }
    npy::write(&image, &[14, 10], &values).unwrap();
    let message = Dataset::open(dir.path()).unwrap_err().to_string();
    assert!(message.contains("[14, 10]") && message.contains("needs [10, 14]"), "{message}");
}

/// Opens the golden dataset with other heart phases in its training and test frames.
fn with_phases(train: [f64; 2], test: [f64; 2]) -> nertca_vk::error::Result<Dataset> {
    let dir = copied();
    for (file, phases) in [("train-golden.json", train), ("test-golden.json", test)] {
        let file = dir.path().join(file);
        let mut list: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        phases.iter().enumerate().for_each(|(i, phase)| list["frames"][i]["heart_phase"] = (*phase).into());
        std::fs::write(&file, list.to_string()).unwrap();
    }
    Dataset::open(dir.path())
}

#[test]
fn phases_no_table_has_are_refused_by_frame_and_value() {
    for (value, said) in [(-3.0, "-3"), (0.5, "0.5"), (4096.0, "4096")] {
        let message = with_phases([0.0, value], [0.0, 0.0]).unwrap_err().to_string();
        for part in ["train-golden.json", "frames[1].heart_phase", said, "whole number"] {
            assert!(message.contains(part), "{value}: {part}: {message}");
        }
    }
    let message = with_phases([0.0, 1.0], [-1.0, 0.0]).unwrap_err().to_string();
    assert!(message.contains("test-golden.json: frames[0].heart_phase"), "{message}");
}

#[test]
fn gaps_between_phases_are_reported() {
    assert_eq!(with_phases([0.0, 1.0], [0.0, 1.0]).unwrap().notes, Vec::<String>::new());
    let dataset = with_phases([2.0, 7.0], [3.0, 7.0]).unwrap();
    let numbers: Vec<u32> = dataset.frames.iter().map(|f| f.phase).collect();
    assert_eq!((dataset.n_phases, numbers), (3, vec![0, 2, 1, 2]));
    let [gap, guess] = &dataset.notes[..] else { panic!("{:?}", dataset.notes) };
    assert!(gap.contains("heart_phase 0-1, 4-6") && gap.contains("2-3, 7, are renumbered as 0-2"), "{gap}");
    assert!(guess.contains("no training frame shows phase 1"), "{guess}");
}
