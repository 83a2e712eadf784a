//! Objects that the views do not show, and lengths in other units: `project` and `phantom --tree` say where the object is.

use crate::known_tree::{nertca, ok, text};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Voxels along each side of the cube, and their spacing, mm.
const SIDE: usize = 20;
const SPACING_MM: f64 = 2.0;

/// A cube of attenuation .02 per mm around `centre_mm`, written as NRRD by hand.
fn cube(directory: &Path, centre_mm: [f64; 3]) -> PathBuf {
    let file = directory.join(format!("cube{}.nrrd", centre_mm[0]));
    let origin = centre_mm.map(|c| (c - 0.5 * (SIDE as f64 - 1.0) * SPACING_MM).to_string()).join(",");
    let header = format!(
        "NRRD0004\ntype: float\ndimension: 3\nspace: left-posterior-superior\nsizes: {SIDE} {SIDE} {SIDE}\n\
         space directions: ({SPACING_MM},0,0) (0,{SPACING_MM},0) (0,0,{SPACING_MM})\nspace origin: ({origin})\n\
         endian: little\nencoding: raw\n\n"
    );
    let values = std::iter::repeat_n(0.02f32.to_le_bytes(), SIDE.pow(3)).flatten();
    std::fs::write(&file, header.into_bytes().into_iter().chain(values).collect::<Vec<u8>>()).unwrap();
    file
}

/// Answer of a command that must be refused without leaving a dataset.
#[track_caller]
fn refused(args: &[&str], out: &Path) -> String {
    let answer = nertca(args);
    let said = String::from_utf8_lossy(&answer.stderr).into_owned();
    assert_eq!(answer.status.code(), Some(1), "{args:?}: {said}");
    assert!(!out.exists(), "{args:?} left {}", out.display());
    said
}

#[track_caller]
fn names(said: &str, parts: &[&str]) {
    parts.iter().for_each(|part| assert!(said.contains(part), "`{part}` is missing in: {said}"));
}

#[test]
fn volumes_that_no_view_shows_are_refused_with_their_place() {
    let directory = tempfile::tempdir().unwrap();
    let (far, out) = (cube(directory.path(), [-180.0, -150.0, 900.0]), directory.path().join("out"));
    let project = ["project", text(&far), text(&far), "--size", "32", "-o", text(&out)];
    for vessel in [&[][..], &["--vessel", "0.01"]] {
        let said = refused(&[&project[..], vessel].concat(), &out);
        // The cube extends 20 mm to each side.
        names(&said, &["-200 to -160 mm to the left", "-170 to -130 mm to the back", "880 to 920 mm to the head"]);
        names(&said, &["isocentre (0, 0, 0)", "160 mm", "--centre"]);
    }
    let (_, said) = ok(&[&project[..], &["--centre"]].concat());
    assert!(!said.contains("warning"), "{said}");
}

#[test]
fn what_is_partly_outside_is_told_view_by_view() {
    let directory = tempfile::tempdir().unwrap();
    // Seen along the body's axis from the left to the right, nothing is missing; from the front, half of the cube is.
    let (aside, out) = (cube(directory.path(), [80.0, 0.0, 0.0]), directory.path().join("out"));
    let views = ["--angles", "0,0;90,0", "--test-angles", "none", "--size", "32"];
    let (_, said) = ok(&[&["project", text(&aside), text(&aside), "-o", text(&out)][..], &views].concat());
    names(&said, &["warning: the images show only part of the volumes: view 0 shows 5"]);
    assert!(!said.contains("view 1"), "{said}");
}

#[test]
fn empty_volumes_and_impossible_spacings_are_refused() {
    let directory = tempfile::tempdir().unwrap();
    let (file, out) = (directory.path().join("v.raw"), directory.path().join("out"));
    std::fs::write(&file, vec![0u8; 4 * 8]).unwrap();
    let raw = ["project", text(&file), text(&file), "--raw-size", "2,2,2", "--raw-type", "f32", "-o", text(&out)];
    names(&refused(&[&raw[..], &["--spacing", "1,1,1"]].concat(), &out), &["empty"]);
    // A ray of some hundred mm would have thousands of millions of steps.
    let said = refused(&[&raw[..], &["--spacing", "100,100,1e-6"]].concat(), &out);
    names(&said, &["spacing", "too small", "mm"]);
}

/// A straight vessel along the body, in RAS mm, moved and scaled, with one number replaced.
fn tree(directory: &Path, scale: f64, shift: f64, replaced: Option<(&str, Value)>) -> PathBuf {
    let line = |z: f64| (0..9).map(|i| [shift, 0.0, scale * (8.0 * f64::from(i) - 32.0) + z]).collect::<Vec<_>>();
    let mut tree = json!({
        "branches": [{ "name": "one", "first": 0, "count": 9 }],
        "radius_mm": vec![scale * 1.5; 9],
        "points_mm": [line(0.0), line(4.0)],
    });
    if let Some((place, value)) = replaced {
        *tree.pointer_mut(place).unwrap() = value;
    }
    let file = directory.join("tree.json");
    std::fs::write(&file, tree.to_string()).unwrap();
    file
}

#[test]
fn lengths_of_a_tree_that_cannot_be_mm_are_refused_with_a_word_on_units() {
    let directory = tempfile::tempdir().unwrap();
    let out = directory.path().join("out");
    let cases = [
        (1.0, Some(("/radius_mm/3", json!(1000.0))), "radius_mm[3]"),
        (1.0, Some(("/radius_mm/3", json!(1e6))), "radius_mm[3]"),
        (1.0, Some(("/points_mm/1/4/2", json!(1e20))), "points_mm[1][4]"),
        (1.0, Some(("/points_mm/0/0/0", json!(-1e9))), "points_mm[0][0]"),
        (1.0, Some(("/points_mm/0/0/0", json!(9000.0))), "points_mm"),
        (1000.0, None, "points_mm"),
        (0.001, None, "points_mm"),
    ];
    for (scale, replaced, field) in cases {
        let file = tree(directory.path(), scale, 0.0, replaced.clone());
        let said = refused(&["phantom", text(&out), "--tree", text(&file), "--size", "32", "--phases", "3"], &out);
        names(&said, &["tree.json", field, "micrometres"]);
        assert!(!said.contains("panicked"), "{replaced:?}: {said}");
    }
}

/// Images of a dataset, by name.
fn images(data: &Path) -> Vec<(String, Vec<u8>)> {
    let files = std::fs::read_dir(data.join("images")).unwrap().map(|entry| entry.unwrap().path());
    let mut all: Vec<_> =
        files.map(|file| (file.file_name().unwrap().to_string_lossy().into(), std::fs::read(&file).unwrap())).collect();
    all.sort();
    all
}

#[test]
fn a_tree_far_away_is_refused_and_centred_on_request() {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    let make = |out: &Path, shift: f64, more: &[&str]| {
        let file = tree(directory.path(), 1.0, shift, None);
        let phantom = ["phantom", text(out), "--tree", text(&file), "--size", "32", "--phases", "2"];
        [&phantom[..], more].concat().into_iter().map(str::to_owned).collect::<Vec<String>>()
    };
    let far = make(&at("far"), 512.0, &[]);
    let said = refused(&far.iter().map(String::as_str).collect::<Vec<_>>(), &at("far"));
    // RAS 512 mm to the right is LPS -512 mm to the left.
    names(&said, &["-514 to -510 mm to the left", "no training view", "--centre"]);
    // A CT elsewhere is no background.
    let ct = cube(directory.path(), [-180.0, -150.0, 900.0]);
    let elsewhere = make(&at("ct"), 0.0, &["--background", text(&ct)]);
    let said = refused(&elsewhere.iter().map(String::as_str).collect::<Vec<_>>(), &at("ct"));
    names(&said, &["the voxels of the CT", "-200 to -160 mm to the left", "isocentre"]);
    for (name, shift) in [("near", 0.0), ("moved", 512.0)] {
        let args = make(&at(name), shift, &["--centre"]);
        ok(&args.iter().map(String::as_str).collect::<Vec<_>>());
    }
    assert!(!images(&at("near")).is_empty());
    assert!(images(&at("near")) == images(&at("moved")), "--centre makes the place of the tree irrelevant");
}
