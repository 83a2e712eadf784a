//! Runs during which the C-arm rotates or the table moves, as written by pydicom: frames of one pose are a view, others are
//! views of their own, and the program reports what they can be used for.

use crate::python::python;
use crate::said::{run, text};
use nertca_vk::geometry::{CArm, Geometry};
use nertca_vk::scan::dataset::Dataset;
use std::path::{Path, PathBuf};

const PHASES: usize = 6;
/// Frames of the rotating run, 10 degrees apart.
const TURNING: usize = 12;

fn c_arms(data: &Path) -> Vec<CArm> {
    let c_arm = |geometry: &Geometry| match geometry {
        Geometry::CArm(c_arm) => c_arm.clone(),
        Geometry::Matrix(_) => panic!("a C-arm is expected"),
    };
    Dataset::open(data).unwrap().views.iter().map(|view| c_arm(&view.geometry)).collect()
}

/// Number of frames of each view of a dataset.
fn frames_of_views(data: &Path) -> Vec<usize> {
    let dataset = Dataset::open(data).unwrap();
    (0..dataset.views.len()).map(|view| dataset.frames.iter().filter(|f| f.view == view).count()).collect()
}

#[test]
fn frames_are_of_as_many_views_as_there_were_places() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let angles: Vec<String> = (0..TURNING).map(|i| format!("{},{}", 10 * i as i32 - 60, 5)).collect();
    let phantom = ["--size", "48", "--phases", &PHASES.to_string(), "--no-volumes", "--test-angles", "none"];
    run(&[&["phantom", text(&at("phantom")), "--angles", &angles.join(";")], &phantom[..]].concat(), true);
    let script = crate::root::root().join("tests/python/write_moving_runs.py");
    let outcome = python().arg(script).arg(at("phantom")).arg(directory.path()).output().unwrap();
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
    let import = |out: &str, runs: &[&str], frames: usize| {
        let files: Vec<PathBuf> = runs.iter().map(|run| at(run)).collect();
        let phases: Vec<String> = (0..frames).map(|i| (i % PHASES).to_string()).collect();
        let mut args = vec!["import", "dicom"];
        args.extend(files.iter().map(|file| text(file)));
        let (out, list, all) = (at(out), at("phases.txt"), format!("1-{frames}"));
        std::fs::write(&list, phases.join("\n")).unwrap();
        let n = PHASES.to_string();
        args.extend(["-o", text(&out), "--frames", &all, "--phase-list", text(&list), "--phases", &n]);
        (run(&args, true), out)
    };

    // Each frame of a rotating run is a view with the C-arm's pose.
    let (told, turning) = import("turning", &["turning.dcm"], TURNING);
    assert!(told.contains("its 12 frames belong to 12 views") && told.contains("12 views of 48 x 48 pixels"), "{told}");
    assert_eq!(frames_of_views(&turning), [1; TURNING]);
    let (mut found, truth) = (c_arms(&turning), c_arms(&at("phantom")));
    found.sort_by(|a, b| a.primary_deg.total_cmp(&b.primary_deg));
    for (found, truth) in found.iter().zip(&truth) {
        assert!((found.primary_deg - truth.primary_deg).abs() < 1e-9 && found.secondary_deg == truth.secondary_deg);
    }
    let refused = run(&["train", text(&turning), "-o", text(&at("refused"))], false);
    assert!(refused.contains("no training view has two phases") && refused.contains("preset paper"), "{refused}");
    let few = ["--set", "train.iterations=8", "--set", "train.rays=64", "--no-eval"];
    run(&[&["train", text(&turning), "-o", text(&at("paper")), "--preset", "paper"], &few[..]].concat(), true);

    // Table motion within a twentieth of a pixel is ignored.
    let (told, trembling) = import("trembling", &["trembling.dcm"], PHASES);
    assert!(!told.contains("moves"), "{told}");
    assert_eq!(frames_of_views(&trembling), [PHASES]);

    // A table that rests and then moves: the frames before are one view. The other frames contain no information on
    // vessels, and the run reports that.
    let (told, panned) = import("panned", &["panned.dcm", "other.dcm"], PHASES);
    assert!(told.contains("panned: the C-arm or the table moves, so its 6 frames belong to 4 views"), "{told}");
    let mut counts = frames_of_views(&panned);
    counts.sort_unstable();
    assert_eq!(counts, [1, 1, 1, 3, 6]);
    let farthest = c_arms(&panned).iter().map(|c| c.table_mm).fold([0.0; 3], |a, b| [0, 1, 2].map(|k| b[k].max(a[k])));
    assert!((farthest[0] - 4.0).abs() < 1e-6 && (farthest[1] - 2.0).abs() < 1e-6, "{farthest:?}");
    let short = ["--set", "train.iterations=8", "--set", "gaussians.iterations=8", "--no-eval"];
    let told = run(&[&["train", text(&panned), "-o", text(&at("run"))], &short[..]].concat(), true);
    assert!(told.contains("3 of 12 frames are the only phase of their view"), "{told}");
}
