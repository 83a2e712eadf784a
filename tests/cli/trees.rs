//! Vessels as trees, through the program: angiograms of a known tree are made, and the tree is reconstructed and extracted.
//! VTK opens the files, SciPy compares.
#![allow(missing_docs, clippy::unwrap_used, clippy::expect_used, clippy::undocumented_unsafe_blocks, reason = "tests")]

use crate::known_tree::{PHASES, POINTS, Trained, nertca, ok, text, train, trained};
use crate::program::whole_config;
use crate::python::python;
use nertca_vk::checkpoint;
use nertca_vk::config::Preset;
use nertca_vk_abi::context::*;
use nertca_vk_abi::reconstruction::*;
use nertca_vk_abi::status::{NERTCA_ERROR_BUFFER, NERTCA_OK};
use nertca_vk_abi::tree::nertca_reconstruction_tree;
use nertca_vk_abi::types::{nertca_log, nertca_tree};
use serde_json::{Value, json};
use std::ffi::CString;
use std::path::Path;
use std::ptr::{null, null_mut};

#[test]
fn the_tree_is_the_true_one_in_every_format() {
    // The script also reads the truth and the data, which are beside the run.
    let Trained { directory, run, .. } = trained();
    let to = |name: &str| directory.path().join(name);
    for (name, files) in
        [("beat.json", 1), ("beat.vtp", PHASES + 1), ("beat.swc", PHASES), ("beat.glb", 1), ("beat.dcm", 1)]
    {
        let (made, said) = ok(&["tree", text(run), "-o", text(&to(name))]);
        assert_eq!(made.lines().count(), files, "{made}");
        assert!(made.lines().all(|file| Path::new(file).is_file()));
        assert!(said.contains("\ntracked") || said.contains("; tracked"), "{said}");
    }
    let (one, _) = ok(&["tree", text(run), "-o", text(&to("one.vtp")), "--phase", "2"]);
    assert_eq!(one.trim(), text(&to("one.vtp")), "one phase is one file, under its own name");
    check("check_trees.py", &[directory.path()]);
    check("check_tubes.py", &[&to("beat.glb"), &to("beat.json")]);
    check("check_measurements.py", &[&to("beat.dcm"), &to("beat.json")]);
    for name in ["still.json", "still.glb"] {
        ok(&["tree", text(run), "-o", text(&to(name)), "--phase", "2"]);
    }
    check("check_tubes.py", &[&to("still.glb"), &to("still.json")]);
}

/// Runs one of the tests' scripts.
fn check(script: &str, files: &[&Path]) {
    let script = crate::root::root().join("tests/python").join(script);
    let outcome = python().arg(script).args(files).output().unwrap();
    print!("{}", String::from_utf8_lossy(&outcome.stdout));
    assert!(outcome.status.success(), "{}", String::from_utf8_lossy(&outcome.stderr));
}

fn tree_of(run: &Path, file: &Path, more: &[&str]) -> Value {
    ok(&[&["tree", text(run), "-o", text(file)], more].concat());
    serde_json::from_slice(&std::fs::read(file).unwrap()).unwrap()
}

#[test]
fn fields_that_carry_no_points_are_not_tracked() {
    let (directory, Trained { data, .. }) = (tempfile::tempdir().unwrap(), trained());
    let run = directory.path().join("sets");
    train(data, &run, &["--iterations", "60", "--set", "gaussians.iterations=60", "--set", "gaussians.form=phase"]);
    let file = directory.path().join("sets.json");
    let (_, said) = ok(&["tree", text(&run), "-o", text(&file)]);
    assert!(said.contains("not tracked"), "{said}");
    let tubes = directory.path().join("sets.glb");
    ok(&["tree", text(&run), "-o", text(&tubes)]);
    check("check_tubes.py", &[&tubes, &file]);
    let measurements = directory.path().join("sets.dcm");
    ok(&["tree", text(&run), "-o", text(&measurements)]);
    check("check_measurements.py", &[&measurements, &file]);
    let tree = tree_of(&run, &file, &["--phase", "1"]);
    assert_eq!((&tree["tracked"], &tree["reference_phase"]), (&json!(false), &Value::Null));
    assert!(tree["note"].as_str().unwrap().starts_with("not tracked"));
    assert_eq!(tree["phases"].as_array().unwrap().len(), 1);
    assert!(tree["phases"][0]["length_mm"].as_f64().unwrap() > 80.0, "{}", tree["phases"][0]["length_mm"]);
}

#[test]
fn doubt_holds_what_it_says() {
    let (directory, Trained { run, .. }) = (tempfile::tempdir().unwrap(), trained());
    let tree = tree_of(run, &directory.path().join("all.json"), &[]);
    let rest = &tree["phases"][tree["reference_phase"].as_u64().unwrap() as usize]["branches"];
    for branch in rest.as_array().unwrap() {
        let numbers = |field: &str| serde_json::from_value::<Vec<f64>>(branch[field].clone()).unwrap();
        let points = numbers("radius_mm").len();
        let (doubt_mm, with_motion_mm, existence) =
            (numbers("doubt_mm"), numbers("doubt_with_motion_mm"), numbers("existence"));
        assert_eq!([doubt_mm.len(), with_motion_mm.len(), existence.len()], [points; 3]);
        assert_eq!(doubt_mm, with_motion_mm, "at the reference phase, points have not moved");
        assert!(doubt_mm.iter().all(|mm| (0.01..2.0).contains(mm)), "{doubt_mm:?}");
        assert!(existence.iter().all(|share| (0.5..1.0).contains(share)), "{existence:?}");
        let directions: Vec<[f64; 3]> = serde_json::from_value(branch["doubt_direction"].clone()).unwrap();
        assert!(directions.iter().all(|d| (d.iter().map(|v| v * v).sum::<f64>() - 1.0).abs() < 1e-3));
    }
    let (_, said) = ok(&["tree", text(run), "-o", text(&directory.path().join("one.vtp")), "--phase", "1"]);
    assert!(said.contains("known to"), "{said}");
    let vtp = std::fs::read_to_string(directory.path().join("one.vtp")).unwrap();
    assert!(vtp.contains("\"Doubt\"") && vtp.contains("\"Existence\""));
    // Without the data, the tree comes without doubt, and the program says so.
    let lonely = directory.path().join("lonely");
    std::fs::create_dir(&lonely).unwrap();
    std::fs::copy(checkpoint::newest(run).unwrap(), lonely.join("checkpoint-0000060.safetensors")).unwrap();
    let (_, said) = ok(&["tree", text(&lonely), "-o", text(&directory.path().join("lonely.json"))]);
    assert!(said.contains("doubt") && said.contains("not stated"), "{said}");
}

#[test]
fn options_change_what_is_found() {
    let (directory, Trained { run, .. }) = (tempfile::tempdir().unwrap(), trained());
    let file = |name: &str| directory.path().join(name);
    let branches = |tree: &Value| tree["phases"][0]["branches"].as_array().unwrap().len();
    let usual = tree_of(run, &file("usual.json"), &["--phase", "0"]);
    assert_eq!(branches(&usual), POINTS.len());
    // Both branches are shorter than that.
    let stem = tree_of(run, &file("stem.json"), &["--phase", "0", "--min-branch", "100"]);
    assert_eq!(branches(&stem), 1);
    let threshold = usual["threshold_per_mm"].as_f64().unwrap();
    let high = tree_of(run, &file("high.json"), &["--phase", "0", "--threshold", &(1.5 * threshold).to_string()]);
    assert!((high["threshold_per_mm"].as_f64().unwrap() / threshold - 1.5).abs() < 1e-9);
}

#[test]
fn the_next_view_shows_vessels_apart() {
    let Trained { directory, run, .. } = trained();
    let picture = directory.path().join("next.png");
    let (said, _) = ok(&["next", text(run), "-o", text(&picture)]);
    let suggested: Vec<&str> = said.lines().collect();
    assert_eq!(suggested.len(), 3, "{said}");
    assert!(suggested.iter().all(|line| line.contains("degrees from the nearest training view")), "{said}");
    let drawn = image::open(&picture).unwrap();
    assert_eq!((drawn.width(), drawn.height()), (37 * 16 + 128, 17 * 16 + 128), "a cell per five degrees");

    let limits = ["--primary", "-40,40", "--secondary=-10,20", "--step", "10", "--json"];
    let answer = |more: &[&str]| -> Value {
        serde_json::from_str(&ok(&[&["next", text(run)], &limits[..], more].concat()).0).unwrap()
    };
    let whole = answer(&[]);
    let positions = whole["positions"].as_array().unwrap();
    assert_eq!(positions.len(), 9 * 4);
    let cost = |candidate: &Value| candidate["cost"].as_f64().unwrap();
    let least = positions.iter().map(cost).fold(f64::INFINITY, f64::min);
    assert_eq!(cost(&whole["suggested"][0]), least);
    let is_within = |candidate: &Value, field: &str, low: f64, high: f64| {
        (low..=high).contains(&candidate[field].as_f64().unwrap())
    };
    assert!(positions.iter().all(|c| is_within(c, "primary_deg", -40.0, 40.0)));
    assert!(positions.iter().all(|c| is_within(c, "secondary_deg", -10.0, 20.0)));
    // The sight of a branch is that of the branch alone.
    let of_branch = answer(&["--branch", "0"]);
    assert_eq!(of_branch["branch"], 0);
    assert!(of_branch["positions"][0]["foreshortening"] != positions[0]["foreshortening"]);

    for (more, parts) in [
        (&["--branch", "99"][..], "branches 0 to "),
        (&["--primary", "40,-40"], "primary"),
        (&["--secondary", "7"], "LOW,HIGH"),
        (&["--step", "0.1"], "step"),
    ] {
        let out = nertca(&[&["next", text(run)], more].concat());
        let stderr = String::from_utf8_lossy(&out.stderr);
        assert!(out.status.code() == Some(2) && stderr.contains(parts), "{more:?}: {stderr}");
    }
}

#[test]
fn what_has_no_tree_is_refused() {
    let (directory, Trained { data, run, .. }) = (tempfile::tempdir().unwrap(), trained());
    let out = directory.path().join("x.json");
    let refuses = |run: &Path, out: &Path, more: &[&str], parts: &[&str]| {
        let args = [&["tree", text(run), "-o", text(out)], more].concat();
        let answer = nertca(&args);
        let stderr = String::from_utf8_lossy(&answer.stderr);
        assert_eq!(answer.status.code(), Some(2), "{args:?}: {stderr}");
        parts.iter().for_each(|part| assert!(stderr.contains(part), "{args:?} does not name `{part}`: {stderr}"));
        assert!(!out.exists());
    };
    refuses(run, &directory.path().join("x.vtk"), &[], &["--out", "x.vtk", ".json .vtp .swc .glb"]);
    refuses(run, &directory.path().join("tree"), &[], &["--out", ".json .vtp .swc .glb"]);
    refuses(run, &out, &["--threshold", "1e3"], &["threshold_per_mm", "no vessel", "lower"]);
    refuses(run, &out, &["--threshold", "0"], &["threshold_per_mm = 0", "positive"]);
    refuses(run, &out, &["--threshold", "nan"], &["threshold_per_mm", "positive"]);
    refuses(run, &out, &["--min-branch=-1"], &["least_branch_mm = -1", "positive"]);
    refuses(run, &out, &["--phase", "4"], &["--phase", "0 to 3"]);
    // A network that starts at zero, and is not trained yet, has no vessels.
    let young = directory.path().join("young");
    let nothing = ["dynamic.best_start=false", "dynamic.normalised_shift=-15"];
    let config = whole_config(directory.path(), Preset::FastMlp, &nothing);
    train(data, &young, &["--config", text(&config), "--iterations", "1"]);
    refuses(&young, &out, &[], &["phase 0", "no vessel", "report"]);
}

#[test]
fn c_callers_get_the_same_tree() {
    let (directory, Trained { run, .. }) = (tempfile::tempdir().unwrap(), trained());
    // A checkpoint alone, whose training images are not known, as for the caller.
    let newest = checkpoint::newest(run).unwrap();
    let alone = directory.path().join("alone.safetensors");
    std::fs::copy(&newest, &alone).unwrap();
    let written = tree_of(&alone, &directory.path().join("all.json"), &[]);
    let none: *const nertca_log = null();
    let (mut context, mut reconstruction) = (null_mut(), null_mut());
    assert_eq!(unsafe { nertca_context_create(null(), none, &mut context) }, NERTCA_OK);
    let options = CString::new(format!("phases = {PHASES}")).unwrap();
    let made = unsafe { nertca_reconstruction_create(context, options.as_ptr(), &mut reconstruction) };
    assert_eq!(made, NERTCA_OK);
    let path = CString::new(text(&newest)).unwrap();
    assert_eq!(unsafe { nertca_reconstruction_load(reconstruction, path.as_ptr()) }, NERTCA_OK);

    let mut room: nertca_tree = unsafe { std::mem::zeroed() };
    room.size = size_of::<nertca_tree>();
    assert_eq!(unsafe { nertca_reconstruction_tree(reconstruction, &mut room) }, NERTCA_OK);
    assert_eq!((room.followed, room.branches), (1, PHASES * POINTS.len()));
    assert!((room.threshold_per_mm / written["threshold_per_mm"].as_f64().unwrap() - 1.0).abs() < 1e-9);
    let (n, points) = (room.branches, room.points);
    let (mut phase, mut parent, mut first, mut count) = (vec![9; n], vec![9; n], vec![9; n], vec![9; n]);
    let (mut points_mm, mut radius_mm) = (vec![f64::NAN; 3 * points], vec![f64::NAN; points]);
    room.branch_phase = phase.as_mut_ptr();
    room.branch_parent = parent.as_mut_ptr();
    room.branch_first = first.as_mut_ptr();
    room.branch_points = count.as_mut_ptr();
    room.points_mm = points_mm.as_mut_ptr();
    room.radius_mm = radius_mm.as_mut_ptr();
    let mut doubt_mm = vec![0.0; points];
    room.doubt_mm = doubt_mm.as_mut_ptr();
    // Insufficient room is refused, and nothing is written.
    room.points -= 1;
    assert_eq!(unsafe { nertca_reconstruction_tree(reconstruction, &mut room) }, NERTCA_ERROR_BUFFER);
    assert!(room.points == points && radius_mm[0].is_nan() && phase[0] == 9);
    assert_eq!(unsafe { nertca_reconstruction_tree(reconstruction, &mut room) }, NERTCA_OK);

    let numbers = |value: &Value| value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect::<Vec<_>>();
    let mut branch = 0;
    for (tree, of_phase) in written["phases"].as_array().unwrap().iter().enumerate() {
        let root = branch as i64;
        for wanted in of_phase["branches"].as_array().unwrap() {
            let found_parent = i64::from(parent[branch]);
            assert_eq!(wanted["parent"].as_i64().map_or(-1, |p| root + p), found_parent, "branch {branch}");
            assert_eq!(phase[branch] as usize, tree);
            let range = first[branch] as usize..(first[branch] + count[branch]) as usize;
            let wanted_mm: Vec<f64> = wanted["points_mm"].as_array().unwrap().iter().flat_map(numbers).collect();
            let found_mm = &points_mm[3 * range.start..3 * range.end];
            assert_eq!(wanted_mm.len(), found_mm.len());
            // The file is rounded to a tenth of a micrometre.
            assert!(wanted_mm.iter().zip(found_mm).all(|(a, b)| (a - b).abs() < 1e-4), "branch {branch}");
            let radii = numbers(&wanted["radius_mm"]);
            assert!(
                radii.len() == range.len() && radii.iter().zip(&radius_mm[range]).all(|(a, b)| (a - b).abs() < 1e-4)
            );
            branch += 1;
        }
    }
    assert_eq!(branch, n);
    assert!(doubt_mm.iter().all(|doubt| doubt.is_nan()), "a checkpoint has no frames to compare with");
    assert_eq!(unsafe { nertca_reconstruction_destroy(reconstruction) }, NERTCA_OK);
    assert_eq!(unsafe { nertca_context_destroy(context) }, NERTCA_OK);
}
