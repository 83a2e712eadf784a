//! Known vessels, angiograms of them, and a short run on these, shared by tests of trees.
#![allow(dead_code, missing_docs, clippy::unwrap_used, clippy::expect_used, reason = "each test file uses its part")]

use crate::program::program;
use serde_json::{Value, json};
use std::f64::consts::PI;
use std::path::{Path, PathBuf};
use std::process::Output;
use std::sync::OnceLock;

pub const PHASES: usize = 4;
/// Points of the trunk and of each branch.
pub const POINTS: [usize; 3] = [40, 50, 50];

/// The true vessels at rest: a trunk and two branches, RAS mm.
fn rest() -> Vec<[f64; 3]> {
    let trunk = |a: f64| [4.0 * (3.0 * a).sin() * (1.0 - a), 6.0 * (2.0 * a).sin() * (1.0 - a), 35.0 * (1.0 - a)];
    let left = |a: f64| [-28.0 * a, (10.0 + 6.0 * (3.0 * a).sin()) * a, -(38.0 * a + 4.0) * a];
    let right = |a: f64| [(26.0 + 4.0 * (4.0 * a).sin()) * a, -8.0 * a, -34.0 * a];
    let courses: [&dyn Fn(f64) -> [f64; 3]; 3] = [&trunk, &left, &right];
    let along = |(n, course): (usize, &dyn Fn(f64) -> [f64; 3])| {
        (0..n).map(|i| course(i as f64 / (n - 1) as f64)).collect::<Vec<_>>()
    };
    POINTS.into_iter().zip(courses).flat_map(along).collect()
}

/// The true vessels over the beat, as `phantom --tree` reads them.
fn truth(phases: usize) -> Value {
    let squeezed = |phase: usize| {
        let squeeze = (PI * phase as f64 / phases as f64).sin().powi(2);
        let (across, along) = (1.0 - 0.12 * squeeze, 1.0 - 0.08 * squeeze);
        let moved =
            |[x, y, z]: [f64; 3]| [x * across + 3.0 * squeeze, y * across - 4.0 * squeeze, z * along + 6.0 * squeeze];
        rest().into_iter().map(moved).collect::<Vec<_>>()
    };
    let radius = |first: f64, last: f64, n: usize| {
        (0..n).map(move |i| first + (last - first) * i as f64 / (n - 1) as f64).collect::<Vec<_>>()
    };
    let [trunk, left, right] = POINTS;
    let radii = [radius(2.0, 1.8, trunk), radius(1.6, 1.0, left), radius(1.5, 0.9, right)].concat();
    json!({
        "branches": [
            { "name": "trunk", "first": 0, "count": trunk },
            { "name": "left", "first": trunk, "count": left },
            { "name": "right", "first": trunk + left, "count": right },
        ],
        "radius_mm": radii,
        "points_mm": (0..phases).map(squeezed).collect::<Vec<_>>(),
    })
}

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

pub fn nertca(args: &[&str]) -> Output {
    program().arg("--validate").args(args).output().unwrap()
}

/// Output of the program on stdout and stderr.
#[track_caller]
pub fn ok(args: &[&str]) -> (String, String) {
    let out = nertca(args);
    let said = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    assert!(out.status.success(), "{args:?}: {}", said(&out.stderr));
    (said(&out.stdout), said(&out.stderr))
}

pub struct Trained {
    pub directory: tempfile::TempDir,
    pub data: PathBuf,
    pub run: PathBuf,
}

/// A short run on the true vessels, created once.
pub fn trained() -> &'static Trained {
    static RUN: OnceLock<Trained> = OnceLock::new();
    RUN.get_or_init(|| {
        let directory = tempfile::tempdir().unwrap();
        let (data, run) = (directory.path().join("data"), directory.path().join("run"));
        // The detector is off centre, so that errors in its handling are detected.
        phantom(&data, PHASES, &["--size", "64", "--offset", "2.5,-1.5"]);
        train(&data, &run, &["--iterations", "60", "--set", "gaussians.iterations=60", "--tree"]);
        Trained { directory, data, run }
    })
}

/// Angiograms of the true vessels.
pub fn phantom(data: &Path, phases: usize, more: &[&str]) {
    let tree = data.with_file_name("truth.json");
    std::fs::write(&tree, truth(phases).to_string()).unwrap();
    ok(&[&["phantom", text(data), "--tree", text(&tree), "--phases", &phases.to_string()], more].concat());
}

pub fn train(data: &Path, run: &Path, more: &[&str]) {
    ok(&[&["train", text(data), "-o", text(run), "--no-eval"], more].concat());
}
