//! Stenoses of phantoms and of the trees that are found in them, through the program.

#![allow(clippy::unwrap_used, clippy::undocumented_unsafe_blocks, reason = "tests of C functions")]

use crate::program::program;
use crate::tree_pages::{Server, python_test};
use nertca_vk::checkpoint;
use nertca_vk_abi::context::*;
use nertca_vk_abi::reconstruction::*;
use nertca_vk_abi::status::{NERTCA_ERROR_ARGUMENT, NERTCA_ERROR_NOT_READY, NERTCA_OK};
use nertca_vk_abi::tree::{nertca_reconstruction_lesion, nertca_reconstruction_tree};
use nertca_vk_abi::types::{nertca_lesion, nertca_log, nertca_tree};
use serde_json::Value;
use std::ffi::CString;
use std::path::Path;
use std::ptr::{null, null_mut};

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[track_caller]
fn ok(args: &[&str]) -> String {
    let out = program().args(args).output().unwrap();
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8_lossy(&out.stderr).into_owned()
}

fn read(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Trains on a phantom with further options; returns its truth, its tree, and the words of the tree command.
fn lesions_of(directory: &Path, more: &[&str]) -> (Value, Value, String) {
    let at = |name: &str| directory.join(name);
    let size = ["--size", "80", "--phases", "6", "--volumes-every", "6", "--test-angles=-5,40"];
    ok(&[&["phantom", text(&at("data"))], &size[..], more].concat());
    ok(&["train", text(&at("data")), "-o", text(&at("run")), "--no-eval", "--stop-at", "130", "--tree"]);
    let said = ok(&["tree", text(&at("run")), "--phase", "0", "-o", text(&at("tree.json"))]);
    (read(&at("data/truth.json")), read(&at("tree.json"))["phases"][0].clone(), said)
}

/// Compares the foreshortening of a lesion in each view with that of its points along the C-arm's axis.
#[track_caller]
fn expect_foreshortening(tree: &Value, lesion: &Value) {
    let index = |field: &str| lesion[field].as_u64().unwrap() as usize;
    let points: Vec<[f64; 3]> = serde_json::from_value(tree["branches"][index("branch")]["points_mm"].clone()).unwrap();
    let part = &points[index("point") - 2..index("point") + 3];
    let views = lesion["views"].as_array().unwrap();
    assert_eq!(views.len(), 4, "{lesion}");
    let mut shares = Vec::new();
    for view in views {
        let angle = |field: &str| view[field].as_f64().unwrap().to_radians();
        let (primary, secondary) = (angle("primary_deg"), angle("secondary_deg"));
        // LAO turns the detector to the patient's left, CRA to the head (left, posterior, superior).
        let axis = [secondary.cos() * primary.sin(), -secondary.cos() * primary.cos(), secondary.sin()];
        let (mut length, mut shown) = (0.0, 0.0);
        for pair in part.windows(2) {
            let step: Vec<f64> = (0..3).map(|k| pair[1][k] - pair[0][k]).collect();
            let along: f64 = (0..3).map(|k| step[k] * axis[k]).sum();
            let squared: f64 = step.iter().map(|v| v * v).sum();
            length += squared.sqrt();
            shown += (squared - along * along).max(0.0).sqrt();
        }
        let share = view["foreshortening"].as_f64().unwrap();
        assert!((share - (1.0 - shown / length)).abs() < 0.08, "{view}: {}", 1.0 - shown / length);
        assert!((0.0..=1.0).contains(&view["overlap"].as_f64().unwrap()), "{view}");
        shares.push(share);
    }
    let (least, most) = shares.iter().fold((1.0f64, 0.0f64), |(a, b), share| (a.min(*share), b.max(*share)));
    assert!(most > least + 0.1, "views differ, so that the comparison means something: {shares:?}");
}

/// Returns the tree of phase 0 of a checkpoint alone, whose training images are not known.
fn tree_of_the_field(directory: &Path) -> Value {
    let (alone, out) = (directory.join("alone.safetensors"), directory.join("of-the-field.json"));
    std::fs::copy(checkpoint::newest(&directory.join("run")).unwrap(), &alone).unwrap();
    let said = ok(&["tree", text(&alone), "--phase", "0", "-o", text(&out)]);
    assert!(said.contains("the radii of vessels are those of the field"), "{said}");
    let tree = read(&out);
    assert_eq!(tree["radii_from"], "field");
    tree["phases"][0].clone()
}

/// Compares the stenoses that C callers get after they have loaded a checkpoint with those of the tree of phase 0.
fn expect_the_same_in_c(newest: &Path, tree: &Value) {
    let none: *const nertca_log = null();
    let (mut context, mut made) = (null_mut(), null_mut());
    let options = CString::new("phases = 6").unwrap();
    let newest = CString::new(text(newest)).unwrap();
    let ok = |status| assert_eq!(status, NERTCA_OK);
    ok(unsafe { nertca_context_create(null(), none, &mut context) });
    ok(unsafe { nertca_reconstruction_create(context, options.as_ptr(), &mut made) });
    ok(unsafe { nertca_reconstruction_load(made, newest.as_ptr()) });
    let mut count = 7;
    let early = unsafe { nertca_reconstruction_lesion(made, 0, null_mut(), &mut count) };
    assert_eq!((early, count), (NERTCA_ERROR_NOT_READY, 7), "no tree was asked for");
    let mut room = nertca_tree { size: size_of::<nertca_tree>(), ..unsafe { std::mem::zeroed() } };
    room.radii_from_images = 7;
    ok(unsafe { nertca_reconstruction_tree(made, &mut room) });
    assert_eq!(room.radii_from_images, 0, "a checkpoint has no frames to measure radii in");
    ok(unsafe { nertca_reconstruction_lesion(made, 0, null_mut(), &mut count) });
    let wanted = tree["lesions"].as_array().unwrap();
    assert!(count >= wanted.len(), "{count} at all phases");
    let mut lesion = nertca_lesion { size: size_of::<nertca_lesion>(), ..unsafe { std::mem::zeroed() } };
    for (index, wanted) in wanted.iter().enumerate() {
        ok(unsafe { nertca_reconstruction_lesion(made, index, &mut lesion, null_mut()) });
        let number = |field: &str| wanted[field].as_f64().unwrap();
        assert_eq!(lesion.phase, 0);
        assert_eq!((f64::from(lesion.branch), f64::from(lesion.point)), (number("branch"), number("point")));
        for (ours, field) in [
            (lesion.from_root_mm, "from_root_mm"),
            (lesion.length_mm, "length_mm"),
            (lesion.min_diameter_mm, "min_diameter_mm"),
            (lesion.reference_diameter_mm, "reference_diameter_mm"),
        ] {
            assert!((ours - number(field)).abs() < 1e-3, "{field}: {ours}, {wanted}");
        }
    }
    let beyond = unsafe { nertca_reconstruction_lesion(made, count, &mut lesion, null_mut()) };
    assert_eq!(beyond, NERTCA_ERROR_ARGUMENT);
    ok(unsafe { nertca_reconstruction_destroy(made) });
    ok(unsafe { nertca_context_destroy(context) });
}

/// Scores of the stenoses of a run, from `eval`.
fn lesion_scores(run: &Path) -> Value {
    let out = program().args(["eval", text(run), "--tree", "--json"]).output().unwrap();
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let scores: Value = serde_json::from_slice(&out.stdout).unwrap();
    scores["tree"]["lesions"].clone()
}

/// The viewer marks the stenoses and shows their numbers, and a measurement report has them.
fn expect_shown_and_reported(directory: &Path) {
    let at = |name: &str| directory.join(name);
    for name in ["all.json", "all.dcm"] {
        ok(&["tree", text(&at("run")), "-o", text(&at(name))]);
    }
    python_test("check_measurements.py", &[&at("all.dcm"), &at("all.json")]);
    let viewer = Server::of(&at("run"));
    python_test("check_viewer_lesions.py", &[Path::new(&viewer.url), &at("all.json"), &at("viewer.png")]);
}

/// The stenosis of the phantom does not change, and the fields of the phases show it about as it is. `of_field` is its percentage in the field of
/// phase 0.
fn expect_the_same_over_the_beat(tree: &Path, of_field: f64, percent: f64) {
    let beat: Value = serde_json::from_slice(&std::fs::read(tree).unwrap()).unwrap();
    let lesion = &beat["phases"][0]["lesions"][0];
    let percents: Vec<f64> =
        lesion["over_beat_percent"].as_array().unwrap().iter().map(|value| value.as_f64().unwrap()).collect();
    assert_eq!(percents.len(), beat["phases"].as_array().unwrap().len());
    assert!(
        (percents[0] - of_field).abs() < 1.0,
        "points are followed from phase 0: {percents:?}, {of_field} in its field"
    );
    let mean = percents.iter().sum::<f64>() / percents.len() as f64;
    assert!((mean - percent).abs() < 20.0 && percents[1..] != vec![percents[0]; percents.len() - 1], "{percents:?}");
}

#[test]
fn a_stenosis_of_a_phantom_is_found_where_it_is_and_a_healthy_tree_has_none() {
    let directory = tempfile::tempdir().unwrap();
    let (ill, healthy) = (directory.path().join("ill"), directory.path().join("healthy"));
    let (truth, tree, said) = lesions_of(&ill, &["--stenosis", "LAD,10,60%,6"]);
    let [true_lesion] = &truth["lesions"].as_array().unwrap()[..] else { panic!("{truth}") };
    let [lesion] = &tree["lesions"].as_array().unwrap()[..] else { panic!("{}", tree["lesions"]) };
    let number = |value: &Value, field: &str| value[field].as_f64().unwrap();
    let off = |ours: &str, theirs: &str| (number(lesion, ours) - number(true_lesion, theirs)).abs();
    println!("{lesion}, {true_lesion}");
    assert_eq!(read(&ill.join("tree.json"))["radii_from"], "images");
    let page = std::fs::read_to_string(ill.join("run/report.html")).unwrap();
    assert!(page.contains("Diameters are those that the angiograms show."));
    assert!(off("min_diameter_mm", "min_diameter_mm") < 0.25, "{lesion}, {true_lesion}");
    assert!(off("stenosis_percent", "percent") < 15.0, "{lesion}, {true_lesion}");
    assert!(off("from_root_mm", "from_ostium_mm") < 3.0, "{lesion}, {true_lesion}");
    assert!(said.contains("phase 0: stenosis of "), "{said}");
    let page = std::fs::read_to_string(ill.join("run/report.html")).unwrap();
    assert!(page.contains("stenosis, %") && page.contains("view 3, %"), "the report has a table of stenoses");
    assert!(page.contains("class=\"strip\"") && page.contains("#d0342c"), "the report has the vessel straightened");
    expect_foreshortening(&tree, lesion);
    let of_field = tree_of_the_field(&ill);
    expect_the_same_in_c(&checkpoint::newest(&ill.join("run")).unwrap(), &of_field);
    expect_shown_and_reported(&ill);
    let of_field = number(&of_field["lesions"][0], "stenosis_percent");
    expect_the_same_over_the_beat(&ill.join("all.json"), of_field, number(true_lesion, "percent"));
    let scores = lesion_scores(&ill.join("run"));
    let counts = ["true_lesions", "found", "false_lesions", "severe_false_lesions"].map(|field| scores[field].as_u64());
    assert_eq!(counts, [Some(1), Some(1), Some(0), Some(0)], "{scores}");
    // The tree of all phases is sampled as that of one phase.
    let radius_mm = 0.5 * (number(lesion, "min_diameter_mm") - number(true_lesion, "min_diameter_mm"));
    assert!((number(&scores, "min_radius_error_mm") - radius_mm).abs() < 0.01, "{scores}");
    let points = off("stenosis_percent", "percent");
    assert!((number(&scores, "percent_absolute_error") - points).abs() < 0.5, "{scores}");
    assert_eq!(scores["within_10_points"], u64::from(points <= 10.0), "{scores}");

    let (truth, tree, said) = lesions_of(&healthy, &[]);
    assert!(truth.get("lesions").is_none(), "a truth without lesions has no such field");
    assert_eq!(tree["lesions"].as_array().unwrap().len(), 0, "{}", tree["lesions"]);
    assert!(!said.contains("stenosis"), "{said}");
    let scores = lesion_scores(&healthy.join("run"));
    assert_eq!((scores["true_lesions"].as_u64(), scores["false_lesions"].as_u64()), (Some(0), Some(0)), "{scores}");
}

#[test]
fn stenoses_that_cannot_be_made_are_refused_with_the_reason() {
    let directory = tempfile::tempdir().unwrap();
    for (asked, reason) in [
        ("RCA,10,60,6", "its branches are: LM, LAD, LCx"),
        ("LAD,500,60,6", "mm long"),
        ("LAD,10,60", "BRANCH,POSITION,DIAMETER%,LENGTH"),
        ("LAD,10,sixty,6", "BRANCH,POSITION,DIAMETER%,LENGTH"),
        ("LAD,10,100,6", "0 to 95 %"),
    ] {
        let out = program()
            .args(["phantom", text(&directory.path().join("data")), "--size", "16", "--phases", "2"])
            .args(["--stenosis", asked])
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&out.stderr);
        assert!(!out.status.success() && said.contains(reason), "{asked}: {said}");
        assert!(!directory.path().join("data/dataset.json").exists(), "{asked}");
    }
}
