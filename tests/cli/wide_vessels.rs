//! Vessels much wider than coronary arteries, and vessels as thin as a pixel, from the phantom to the tree.

use crate::program::program;
use serde_json::{Value, json};
use std::path::Path;

/// Number of points of a tube.
const POINTS: usize = 46;
/// Number of phases at which a tube is stated.
const PHASES: usize = 10;

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[track_caller]
fn ok(args: &[&str]) {
    let out = program().args(args).output().unwrap();
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
}

/// A straight tube of 90 mm, oblique to all views, that moves to and fro across itself by `motion_mm`.
fn tube(radius_mm: f64, motion_mm: f64) -> Value {
    let along = [0.233, 0.326, 0.916];
    let across = [0.83, 0.5, 0.25];
    let at = |phase: usize, point: usize| {
        let moved = 0.5 * motion_mm * (std::f64::consts::TAU * phase as f64 / PHASES as f64).cos();
        let place = 2.0 * point as f64 - 45.0;
        [0, 1, 2].map(|axis| along[axis] * place + across[axis] * moved)
    };
    let line = |phase: usize| (0..POINTS).map(|point| at(phase, point)).collect::<Vec<_>>();
    json!({
        "branches": [{ "name": "tube", "first": 0, "count": POINTS }],
        "radius_mm": vec![radius_mm; POINTS],
        "points_mm": (0..PHASES).map(line).collect::<Vec<_>>(),
    })
}

/// Reconstructs a tube; returns the number of branches at the first phase, and the longest branch's median radius in mm.
fn found(radius_mm: f64, motion_mm: f64) -> (usize, f64) {
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name);
    std::fs::write(at("tube.json"), tube(radius_mm, motion_mm).to_string()).unwrap();
    ok(&["phantom", text(&at("data")), "--tree", text(&at("tube.json")), "--no-volumes", "--test-angles", "none"]);
    ok(&["train", text(&at("data")), "-o", text(&at("run")), "--no-eval", "--stop-at", "130"]);
    ok(&["tree", text(&at("run")), "--phase", "0", "-o", text(&at("tree.json"))]);
    let tree: Value = serde_json::from_slice(&std::fs::read(at("tree.json")).unwrap()).unwrap();
    let branches = tree["phases"][0]["branches"].as_array().unwrap();
    let length = |branch: &&Value| branch["length_mm"].as_f64().unwrap();
    let longest = branches.iter().max_by(|a, b| length(a).total_cmp(&length(b))).unwrap();
    let mut radii_mm: Vec<f64> = serde_json::from_value(longest["radius_mm"].clone()).unwrap();
    radii_mm.sort_by(f64::total_cmp);
    (branches.len(), radii_mm[radii_mm.len() / 2])
}

#[test]
#[ignore = "long: tools/test --all"]
fn tubes_of_any_width_are_found_whole() {
    // Pixels are 1.6 mm wide. Tubes that move less than their width show no background in their middle.
    for (radius_mm, motion_mm) in [(10.0, 2.0), (10.0, 8.0), (5.0, 4.0), (0.8, 6.0)] {
        let (branches, found_mm) = found(radius_mm, motion_mm);
        assert!(branches <= 3, "{branches} branches for a radius of {radius_mm} mm and a motion of {motion_mm} mm");
        assert!((found_mm / radius_mm - 1.0).abs() < 0.15, "{found_mm} mm instead of {radius_mm} mm");
    }
}
